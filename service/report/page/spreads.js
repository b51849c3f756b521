// Distributions of durations: counts over logarithmic bins, both axes logarithmic, with the percentiles marked.

const RATIO = 2 ** (1 / 16); // from one bin's edge to the next
const NONE = 0.5; // stands for no count on a logarithmic axis

/** The outline of a histogram; bins that are empty go down to the axis. */
function outline(bins) {
  const [x, y] = [[], []];
  let end = null;
  for (const [edge, count] of bins) {
    if (end === null || edge > end * 1.001) {
      if (end !== null) (x.push(end), y.push(NONE));
      x.push(edge);
      y.push(NONE);
    }
    x.push(edge, edge * RATIO);
    y.push(count, count);
    end = edge * RATIO;
  }
  if (end !== null) (x.push(end), y.push(NONE));
  return { x, y };
}

const percentiles = { p50: "p50", p99: "p99", p999: "p99.9" };

function spreadTrace(run, index) {
  const line = colour("--measured");
  return {
    type: "scatter",
    mode: "lines",
    ...outline(run.bins),
    name: plain(data.runs[index].name),
    visible: !hiddenRuns.has(index),
    line: several ? runStroke(index) : { color: line, width: 1 },
    ...(!several && { fill: "toself", fillcolor: line.replace("rgb(", "rgba(").replace(")", ", 0.28)") }),
    hoverinfo: "skip",
  };
}

/** A percentile as a vertical line; for a single run, with its name and value. */
function markPercentiles(layout, run, index) {
  Object.entries(percentiles).forEach(([key, name], row) => {
    const at = Math.log10(run[key]);
    const line = { color: several ? colour(`--run-${index % 8}`) : colour("--ink"), width: 1, dash: "dot" };
    layout.shapes.push({ type: "line", x0: run[key], x1: run[key], yref: "paper", y0: 0, y1: 1, line });
    if (several) return;
    layout.annotations.push({
      text: `${name} ${duration(run[key])}`, x: at, y: 1 - 0.1 * row, yref: "paper", yanchor: "top", showarrow: false,
      xanchor: "left", xshift: 3, font: { color: colour("--ink"), size: 12 }, bgcolor: colour("--paper"), borderpad: 1,
    });
  });
}

async function drawSpread(figure) {
  const spread = data.spreads.find((each) => each.id === figure.dataset.name);
  const runs = spread.runs.map((run, index) => [run, index]).filter(([run]) => run && run.bins.length);
  const edges = runs.flatMap(([run]) => [run.bins[0][0], run.bins.at(-1)[0] * RATIO]);
  const counts = runs.flatMap(([run]) => run.bins.map(([, count]) => count));
  const grid = { gridcolor: colour("--grid"), zeroline: false, fixedrange: true };
  const from = Math.log10(Math.min(...edges)) - 0.05;
  const to = Math.log10(Math.max(...edges)) + 0.3;
  const layout = {
    ...plainLayout(),
    margin: { l: 54, r: 10, t: 8, b: 36 },
    hovermode: false,
    dragmode: false,
    xaxis: { ...grid, type: "log", range: [from, to], tickangle: 0, ...durationTicks(from, to) },
    yaxis: { ...grid, type: "log", range: [Math.log10(NONE), Math.log10(Math.max(1, ...counts)) + 0.15], dtick: 1,
      title: { text: "count", standoff: 6 }, exponentformat: "power" },
  };
  for (const [run, index] of runs) if (!hiddenRuns.has(index)) markPercentiles(layout, run, index);
  await Plotly.react(figure.querySelector(".plot"), runs.map(([run, index]) => spreadTrace(run, index)), layout, plotOptions);
  if (several) showKey(figure, runs.map(([, index]) => [data.runs[index].name, `--run-${index % 8}`, runDash(index), index]));
}
