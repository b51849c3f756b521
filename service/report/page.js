// Drawings of the page: what is in sight is drawn, and all time axes move together. drawings.py prepares what is drawn.
"use strict";

const { span, times, drawings } = JSON.parse(document.getElementById("data").textContent);
const plots = [...document.querySelectorAll(".plot")];
const pointed = matchMedia("(pointer: fine)").matches || !matchMedia("(any-pointer: coarse)").matches;
const options = { displayModeBar: false, responsive: true, doubleClick: false, showTips: false };
let shown = [...span]; // by every time axis [s]
let jumpedTo = null; // time of an event [s]
let round = 0; // of drawing everything

/** Numbers of one of Plotly's typed arrays, [f4] or [f8]; empty where there are none. */
function numbers({ dtype, bdata = "" }) {
  const letters = atob(bdata);
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return dtype === "f4" ? new Float32Array(bytes.buffer) : new Float64Array(bytes.buffer);
}

const runTimes = times.map(numbers);
for (const { data } of Object.values(drawings)) for (const line of data) line.y = numbers(line.y);

/** Index of the first time that is not before another. */
function firstAt(instants, time) {
  let [low, high] = [0, instants.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    [low, high] = instants[middle] < time ? [middle + 1, high] : [low, middle];
  }
  return low;
}

/** What of a line is in sight, in a drawing so many pixels wide.

    Where there are few ticks, each of them; else the least and the largest value of each column of pixels, where they were.
*/
function inView(x, y, pixels) {
  const [from, to] = shown;
  const [begin, end] = [Math.max(0, firstAt(x, from) - 1), Math.min(x.length, firstAt(x, to) + 1)];
  if (end - begin <= 6 * pixels) return { x: x.slice(begin, end), y: y.slice(begin, end) };
  const drawn = { x: [], y: [], isReduced: true };
  for (let i = begin; i < end; ) {
    const until = x[i] + (to - from) / pixels;
    let [low, high] = [i, i];
    for (; i < end && x[i] < until; i++) {
      if (y[i] < y[low] || Number.isNaN(y[low])) low = i;
      if (y[i] > y[high] || Number.isNaN(y[high])) high = i;
    }
    for (const at of new Set([Math.min(low, high), Math.max(low, high)])) drawn.x.push(x[at]), drawn.y.push(y[at]);
  }
  return drawn;
}

/** Draw a figure, or draw it again at another time; `size` is its width and height on paper [px]. */
function draw(plot, size = {}) {
  const { data, layout } = drawings[plot.dataset.name];
  const isFirst = plot.data === undefined;
  if (isFirst) plot.replaceChildren(); // of a page that a browser saved with its drawings
  const traces = data.map((line) => {
    const { isReduced, ...points } = inView(runTimes[line.times], line.y, Math.max(300, plot.clientWidth - 88));
    return { ...line, ...points, line: { ...line.line, shape: isReduced ? "linear" : line.line.shape } };
  });
  const here = { type: "path", path: `M${jumpedTo},0 L${jumpedTo},1`, yref: "paper", layer: "below", opacity: 0.35,
    line: { color: "#00629b", width: 9 } };
  const view = { ...layout, ...size, dragmode: pointed ? "zoom" : false, xaxis: { ...layout.xaxis, range: [...shown] },
    shapes: jumpedTo === null ? layout.shapes : [...layout.shapes, here] };
  view.font = { ...layout.font, family: getComputedStyle(document.body).fontFamily };
  Plotly.react(plot, traces, view, options);
  if (!isFirst) return;
  plot.on("plotly_relayout", (change) => {
    if ("xaxis.range[0]" in change) showTime(change["xaxis.range[0]"], change["xaxis.range[1]"]);
  });
  plot.on("plotly_doubleclick", () => showTime(...span, null));
}

/** Draw every figure again, those in sight first; stops where the time is moved meanwhile. */
async function redraw() {
  const mine = ++round;
  const distance = (plot) => Math.abs(plot.getBoundingClientRect().top);
  for (const plot of [...plots].sort((a, b) => distance(a) - distance(b))) {
    if (mine !== round) return;
    draw(plot);
    await new Promise((drawn) => setTimeout(drawn));
  }
}

/** Show a span of time everywhere; what lies outside the run is left out. */
function showTime(from, to, marked = jumpedTo) {
  const [start, end] = span;
  const width = Math.min(Math.max(to - from, Math.min((end - start) / 10, 0.002)), end - start);
  const middle = Math.min(Math.max((from + to) / 2, start + width / 2), end - width / 2);
  [shown, jumpedTo] = [[middle - width / 2, middle + width / 2], marked];
  redraw();
}

const moves = { earlier: [-1, -1], later: [1, 1], in: [1, -1], out: [-2, 2] }; // in quarters of what is shown

document.addEventListener("click", ({ target }) => {
  const { move, time } = target.closest("[data-move], [data-time]")?.dataset ?? {};
  if (move === "whole") showTime(...span, null);
  else if (move) showTime(...shown.map((each, i) => each + (moves[move][i] * (shown[1] - shown[0])) / 4));
  if (time) {
    const half = Math.min((span[1] - span[0]) / 2, Math.max(0.5, (span[1] - span[0]) / 50));
    showTime(Number(time) - half, Number(time) + half, Number(time));
    document.getElementById("tracking").scrollIntoView();
  }
});

for (const plot of plots) draw(plot); // all at once, so that a page saved or printed at once has its drawings
addEventListener("beforeprint", () => {
  for (const plot of plots) draw(plot, { width: 465, height: 60 + 100 * plot.dataset.panels, autosize: false });
});
addEventListener("afterprint", () => {
  plots.forEach(Plotly.purge); // which forgets the size on paper
  redraw();
});
