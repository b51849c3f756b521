// Drawings over time: the panels of a group under each other on one time axis, with bands, events and gaps across them.

const MARKS_ACROSS = 500; // marks closer than this share of a drawing are merged

/** A line's colour by its meaning: measured, desired, true, or its run. */
function lineColour(line) {
  if (several) return line.shared ? "--quiet" : `--run-${line.run % 8}`;
  if (line.desired) return "--desired";
  return line.nth ? "--other" : "--measured";
}

/** Whether it is a run's own desired line, beside others. */
const isOwn = (line) => several && line.desired && !line.shared;

/** Whether it stands for its run: not what is desired, nor a second line beside it. */
const isMain = (line) => several && !line.desired && !line.nth;

function lineName(line) {
  const run = data.runs[line.run].name;
  if (!several || line.shared) return line.label;
  return line.desired || line.nth ? `${run}, ${line.label}` : run;
}

function stroke(line) {
  if (isMain(line)) return runStroke(line.run);
  const color = colour(lineColour(line));
  if (several && !line.shared) return { color, width: 1, dash: line.desired ? "1px,3px" : "5px,5px" };
  return { color, width: line.desired ? 2.5 : 1.1, dash: line.held || line.desired ? "solid" : "6px,4px" };
}

/** What a line needs to be drawn between two times, in a drawing so many pixels wide.

    Where there are few ticks, each of them; else the least and the largest value of each column of pixels, where they
    were. Half a drawing more on either side, for panning.
*/
function inView({ x, y }, [from, to], pixels) {
  const room = (to - from) / 2;
  const begin = Math.max(0, firstAt(x, from - room) - 1);
  const end = Math.min(x.length, firstAt(x, to + room) + 1);
  if (end - begin <= 6 * pixels) return { x: x.subarray(begin, end), y: y.subarray(begin, end), everyTick: true };
  const [drawnX, drawnY] = [[], []];
  const width = (to - from) / pixels;
  for (let i = begin; i < end; ) {
    const until = x[i] + width;
    let [low, high] = [i, i];
    for (; i < end && x[i] < until; i++) {
      if (!(y[i] >= y[low])) low = Number.isNaN(y[i]) ? low : i;
      if (!(y[i] <= y[high])) high = Number.isNaN(y[i]) ? high : i;
    }
    for (const at of low < high ? [low, high] : low > high ? [high, low] : [low]) drawnX.push(x[at]), drawnY.push(y[at]);
  }
  return { x: drawnX, y: drawnY };
}

/** The traces of a group. */
function traces(group, pixels) {
  return group.panels.flatMap((panel, row) =>
    inOrder(panel.lines).map((line) => {
      const { x, y, everyTick } = inView(line, timeWindow.shown, pixels);
      return {
        type: "scatter",
        mode: "lines",
        x,
        y,
        yaxis: axisOf(row),
        visible: line.shared || !hiddenRuns.has(line.run),
        name: plain(group.panels.length > 1 ? `${panel.label} ${lineName(line)}` : lineName(line)),
        line: { ...stroke(line), shape: line.held && everyTick && data.runs[line.run].exact ? "hv" : "linear" },
        hovertemplate: `%{y:.${panel.decimals}f}${panel.unit && ` ${panel.unit}`}`,
      };
    }),
  );
}

/** What is desired lies under what is measured, so that both can be seen. */
const inOrder = (lines) => [...lines].sort((one, other) => other.desired - one.desired);

const axisOf = (row) => (row ? `y${row + 1}` : "y");

/** Least and largest value of a panel within the time that is shown, with some room. */
function extent(panel) {
  const [from, to] = timeWindow.shown;
  let [least, most] = [Infinity, -Infinity];
  for (const { x, y, run, shared } of panel.lines) {
    if (hiddenRuns.has(run) && !shared) continue;
    for (let i = firstAt(x, from); i < x.length && x[i] <= to; i++) {
      if (y[i] < least) least = y[i];
      if (y[i] > most) most = y[i];
    }
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

/** The bands that are in sight. */
function bandsShown() {
  const [from, to] = timeWindow.shown;
  return data.bands.filter((band) => band.to >= from && band.from <= to && !hiddenRuns.has(band.run));
}

const BAND_ROWS = Math.min(3, data.bands.length); // of labels, so that neighbours do not overlap

/** Labels of the bands, above the first panel. */
function bandLabels() {
  const [from, to] = timeWindow.shown;
  return bandsShown().map((band, i) => ({
    text: plain(several ? `${data.runs[band.run].name}: ${band.label}` : band.label), x: Math.max(band.from, from), y: 1,
    yref: "y domain", xanchor: band.from > (from + to) / 2 ? "right" : "left", yanchor: "bottom", yshift: 15 + 14 * (i % BAND_ROWS),
    showarrow: false, font: { size: 11, color: colour("--ink") }, borderpad: 0,
  }));
}

/** Events as lines across all panels, gaps and bands as areas: a shape for all of a kind, since there may be hundreds. */
function marks() {
  const [from, to] = timeWindow.shown;
  const apart = (to - from) / MARKS_ACROSS;
  const across = { type: "path", yref: "paper", layer: "below" };
  const shapes = [];
  if (timeWindow.marked !== null)
    shapes.push({ ...across, path: `M${timeWindow.marked},0 L${timeWindow.marked},1`, opacity: 0.35,
      line: { color: colour("--accent"), width: 9 } });
  for (const { run, ...band } of bandsShown())
    shapes.push({ ...across, path: `M${band.from},0 L${band.to},0 L${band.to},1 L${band.from},1 Z`, opacity: 0.15,
      line: { width: 0 }, fillcolor: colour(several ? `--run-${run % 8}` : "--band") });
  data.runs.forEach((run, index) => {
    if (hiddenRuns.has(index)) return;
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
    margin: { l: 54, r: 10, t: 22 + 14 * BAND_ROWS, b: 36 },
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
  layout.annotations.push(...bandLabels());
  return layout;
}

/** Draw a group, or draw it again: another time, another theme. */
async function drawGroup(figure) {
  const group = data.groups.find((each) => each.id === figure.dataset.name);
  const plot = figure.querySelector(".plot");
  const first = !plot.classList.contains("js-plotly-plot");
  await Plotly.react(plot, traces(group, Math.max(300, plot.clientWidth - 64)), timeLayout(group), plotOptions);
  if (!first) return;
  plot.on("plotly_relayout", (change) => {
    if ("xaxis.range[0]" in change) showTime(change["xaxis.range[0]"], change["xaxis.range[1]"]);
  });
  plot.on("plotly_doubleclick", () => moveTime("whole"));
  plot.addEventListener("keydown", moveByKey);
  const lines = group.panels.flatMap((panel) => panel.lines).sort((one, other) => one.desired - other.desired);
  const meanings = new Map(lines.map((line) => [isMain(line) ? line.run : line.label, line]));
  if (meanings.size > 1 || several) showKey(figure, [...meanings.values()].map(keyEntry));
}

/** A line's entry in the key: its name, colour, kind of dashes, and the run that it stands for. */
function keyEntry(line) {
  if (isMain(line)) return [data.runs[line.run].name, `--run-${line.run % 8}`, runDash(line.run), line.run];
  if (several) return [line.label, "--quiet", line.shared ? "" : line.desired ? "dot" : "dash"];
  return [line.label, lineColour(line), line.held || line.desired ? "" : "dash"];
}

/** The kind of border that is nearest to a run's dashes. */
const runDash = (run) => (run ? (run % 2 ? "dash" : "dot") : "");
