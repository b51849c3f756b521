// Drawings over time: the panels of a group under each other on one time axis, with events and gaps across all of them.

const MARKS_ACROSS = 500; // marks closer than this share of a drawing are merged

/** A line's colour by its meaning: measured, desired, or its run. */
function lineColour(line) {
  if (several) return line.shared ? "--quiet" : `--run-${line.run % 8}`;
  if (line.desired) return "--desired";
  return line.nth ? "--other" : "--measured";
}

/** Whether it is a run's own desired line, beside others. */
const isOwn = (line) => several && line.desired && !line.shared;

function lineDash(line) {
  if (isOwn(line)) return "dot";
  return several && line.nth ? "dash" : "solid";
}

function lineName(line) {
  const run = data.runs[line.run].name;
  if (!several || line.shared) return line.label;
  return line.desired || line.nth ? `${run}, ${line.label}` : run;
}

/** The traces of a group. */
function traces(group) {
  return group.panels.flatMap((panel, row) =>
    inOrder(panel.lines).map((line) => ({
      type: "scatter",
      mode: "lines",
      x: line.x,
      y: line.y,
      yaxis: axisOf(row),
      name: plain(group.panels.length > 1 ? `${panel.label} ${lineName(line)}` : lineName(line)),
      line: {
        color: colour(lineColour(line)),
        width: line.desired && !isOwn(line) ? 2.5 : 1.1,
        dash: lineDash(line),
      },
      hovertemplate: `%{y:.${panel.decimals}f}${panel.unit && ` ${panel.unit}`}`,
    })),
  );
}

/** What is desired lies under what is measured, so that both can be seen. */
const inOrder = (lines) => [...lines].sort((one, other) => other.desired - one.desired);

const axisOf = (row) => (row ? `y${row + 1}` : "y");

/** Least and largest value of a panel within the time that is shown, with some room. */
function extent(panel) {
  const [from, to] = timeWindow.shown;
  let [least, most] = [Infinity, -Infinity];
  for (const { x, y } of panel.lines)
    for (let i = firstAt(x, from); i < x.length && x[i] <= to; i++) {
      if (y[i] < least) least = y[i];
      if (y[i] > most) most = y[i];
    }
  if (least > most) return panel.log ? [1, 3] : [-1, 1];
  if (panel.log) return [Math.log10(least) - 0.05, Math.log10(most) + 0.05];
  const room = (most - least) * 0.07 || Math.abs(most) * 0.1 || 1;
  return [least - room, most + room];
}

/** Index of the first time that is not before another. */
function firstAt(times, time) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Events as lines across all panels, gaps as bands: a shape for all of a kind, since there may be hundreds. */
function marks() {
  const [from, to] = timeWindow.shown;
  const apart = (to - from) / MARKS_ACROSS;
  const across = { type: "path", yref: "paper", layer: "below" };
  const shapes = [];
  if (timeWindow.marked !== null)
    shapes.push({ ...across, path: `M${timeWindow.marked},0 L${timeWindow.marked},1`, opacity: 0.35,
      line: { color: colour("--accent"), width: 9 } });
  data.runs.forEach((run, index) => {
    const own = several ? colour(`--run-${index % 8}`) : null;
    const gaps = run.gaps.filter(([start, end]) => end >= from && start <= to);
    const bands = gaps.map(([start, end]) => `M${start},0 L${end},0 L${end},1 L${start},1 Z`);
    shapes.push({ ...across, path: bands.join(" "), line: { width: 0 }, opacity: 0.16, fillcolor: own ?? colour("--grave") });
    for (const grave of [false, true]) {
      const seen = [];
      for (const [time, isGrave] of run.marks)
        if (isGrave === grave && time >= from && time <= to && !(time - seen.at(-1) < apart)) seen.push(time);
      shapes.push({ ...across, path: seen.map((time) => `M${time},0 L${time},1`).join(" "), opacity: crowded(seen.length),
        line: { color: own ?? colour(grave ? "--grave" : "--mark"), width: grave ? 1.4 : 1, dash: grave ? "solid" : "dot" } });
    }
  });
  return shapes.filter((shape) => shape.path);
}

/** Many marks are faint, so that what is measured can be seen through them. */
const crowded = (count) => Math.max(0.2, Math.min(1, 30 / count));

function timeLayout(group) {
  const [grid, quiet] = [colour("--grid"), colour("--quiet")];
  const rows = group.panels.length;
  const layout = {
    ...plainLayout(),
    margin: { l: 54, r: 10, t: 22, b: 36 },
    hovermode: "x unified",
    hoversubplots: "axis",
    dragmode: pointed ? "zoom" : false,
    grid: { rows, columns: 1, subplots: group.panels.map((_, row) => [`x${axisOf(row)}`]) },
    xaxis: {
      range: [...timeWindow.shown], anchor: axisOf(rows - 1), title: { text: "time [s]", standoff: 4 }, zeroline: false,
      gridcolor: grid, linecolor: grid, showspikes: true, spikemode: "across", spikethickness: 1, spikedash: "solid",
      spikecolor: quiet, spikesnap: "cursor", hoverformat: ".3f", unifiedhovertitle: { text: "%{x:.3f} s" },
    },
    shapes: marks(),
  };
  group.panels.forEach((panel, row) => {
    const room = 24 / (rows * 132); // for the label above each panel
    layout[`yaxis${row ? row + 1 : ""}`] = {
      domain: [1 - (row + 1) / rows + (row < rows - 1 ? room / 2 : 0), 1 - row / rows - (row ? room / 2 : 0)],
      fixedrange: true, range: extent(panel), type: panel.log ? "log" : "linear", nticks: 5, exponentformat: "power", zeroline: !panel.log,
      zerolinecolor: colour("--rule"), zerolinewidth: 1, gridcolor: grid, ...(panel.log && durationTicks(...extent(panel))),
    };
    layout.annotations.push({
      text: plain(panel.unit ? `${panel.label} [${panel.unit}]` : panel.label), showarrow: false, xref: "paper", x: 0,
      xanchor: "left", xshift: 2, yref: `${axisOf(row)} domain`, y: 1, yanchor: "bottom", font: { color: colour("--ink"), size: 12.5 },
      bgcolor: colour("--paper"), borderpad: 0,
    });
  });
  return layout;
}

/** Draw a group, or draw it again: another time, another theme. */
async function drawGroup(figure) {
  const group = data.groups.find((each) => each.id === figure.dataset.name);
  const plot = figure.querySelector(".plot");
  const first = !plot.classList.contains("js-plotly-plot");
  await Plotly.react(plot, traces(group), timeLayout(group), plotOptions);
  if (!first) return;
  plot.on("plotly_relayout", (change) => {
    if ("xaxis.range[0]" in change) showTime(change["xaxis.range[0]"], change["xaxis.range[1]"]);
  });
  plot.on("plotly_doubleclick", () => moveTime("whole"));
  plot.addEventListener("keydown", moveByKey);
  const lines = group.panels.flatMap((panel) => panel.lines).sort((one, other) => one.desired - other.desired);
  const meanings = new Map(lines.map((line) => [lineName(line), line]));
  if (meanings.size > 1 || several)
    showKey(figure, [...meanings].map(([name, line]) => [name, lineColour(line), lineDash(line)]));
}
