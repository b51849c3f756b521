// Drawings of the page: what is in sight is drawn, and all time axes move together. drawings.py prepares what is drawn.
"use strict";

const { span, times, drawings } = JSON.parse(document.getElementById("data").textContent);
const figures = [...document.querySelectorAll(".drawing")];
const pointed = matchMedia("(pointer: fine)").matches || !matchMedia("(any-pointer: coarse)").matches;
const options = { displayModeBar: false, responsive: true, doubleClick: false, showTips: false };
const [hiddenRuns, inSight, upToDate] = [new Set(), new Set(), new Set()];
let shown = [...span]; // by every time axis [s]
let jumpedTo = null; // time of an event [s]
let frame = null;

/** Numbers of one of Plotly's typed arrays, [f4] or [f8]; empty where there are none. */
function numbers({ dtype, bdata = "" }) {
  const letters = atob(bdata);
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return dtype === "f4" ? new Float32Array(bytes.buffer) : new Float64Array(bytes.buffer);
}

const runTimes = times.map(numbers);

/** A copy of a part of a figure, with the style sheet's colours, such as `var(--ink)`, as the present theme has them. */
function themed(part) {
  if (Array.isArray(part)) return part.map(themed);
  if (typeof part === "object" && part) return Object.fromEntries(Object.entries(part).map(([key, each]) => [key, themed(each)]));
  if (!/^var\(--[\w-]+\)$/.test(part)) return part;
  const probe = document.body.appendChild(document.createElement("i"));
  probe.style.color = part;
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}

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

/** Draw a figure, or draw it again: another time, another theme, another choice of runs. */
async function draw(figure) {
  const { data, layout } = drawings[figure.dataset.name];
  const plot = figure.querySelector(".plot");
  const isFirst = !plot.classList.contains("js-plotly-plot");
  const overTime = figure.classList.contains("group");
  const isSeen = ({ run }) => !hiddenRuns.has(run);
  const traces = data.map(({ x, y, ...style }) => ({ ...themed(style), x, y, visible: isSeen(style) }));
  const view = themed(layout);
  view.font.family = getComputedStyle(document.body).fontFamily;
  view.shapes = view.shapes.filter(isSeen);
  if (overTime) {
    const [from, to] = shown;
    data.forEach((line, i) => {
      if (isFirst) line.y = numbers(line.y);
      const { isReduced, ...points } = inView(runTimes[line.times], line.y, Math.max(300, plot.clientWidth - 64));
      Object.assign(traces[i], points);
      if (isReduced) traces[i].line.shape = "linear";
    });
    view.xaxis.range = [from, to];
    view.dragmode = pointed ? "zoom" : false;
    view.annotations = view.annotations.filter(({ span, run }) => !span || (span[0] <= to && span[1] >= from && isSeen({ run })));
    for (const label of view.annotations)
      if (label.span) [label.x, label.xanchor] = [Math.max(label.span[0], from), label.span[0] > (from + to) / 2 ? "right" : "left"];
    if (jumpedTo !== null)
      view.shapes.push({ type: "path", path: `M${jumpedTo},0 L${jumpedTo},1`, yref: "paper", layer: "below", opacity: 0.35,
        line: { color: themed("var(--accent)"), width: 9 } });
  }
  await Plotly.react(plot, traces, view, options);
  if (!isFirst || !overTime) return;
  plot.on("plotly_relayout", (change) => {
    if ("xaxis.range[0]" in change) showTime(change["xaxis.range[0]"], change["xaxis.range[1]"]);
  });
  plot.on("plotly_doubleclick", () => moveTime("whole"));
}

/** Draw what is in sight and not up to date, once before the next frame. */
function refresh() {
  frame ??= requestAnimationFrame(() => {
    frame = null;
    for (const figure of inSight) if (!upToDate.has(figure)) upToDate.add(figure), draw(figure);
  });
}

function redraw() {
  upToDate.clear();
  refresh();
}

const watcher = new IntersectionObserver((changes) => {
  for (const { target, isIntersecting } of changes) inSight[isIntersecting ? "add" : "delete"](target);
  refresh();
}, { rootMargin: "400px" });
for (const figure of figures) watcher.observe(figure);

// the time that is shown: moved by buttons, keys, drawings and links to instants

/** Show a span of time everywhere; what lies outside the run is left out. */
function showTime(from, to, marked = jumpedTo) {
  const [start, end] = span;
  const width = Math.min(Math.max(to - from, Math.min((end - start) / 10, 0.002)), end - start);
  const middle = Math.min(Math.max((from + to) / 2, start + width / 2), end - width / 2);
  [shown, jumpedTo] = [[middle - width / 2, middle + width / 2], marked];
  const digits = Math.min(3, Math.max(0, 2 - Math.floor(Math.log10(width))));
  document.getElementById("shown").value = `${shown.map((time) => time.toFixed(digits)).join(" – ")} s`.replaceAll("-", "−");
  redraw();
}

const quarters = { earlier: [-1, -1], later: [1, 1], in: [1, -1], out: [-2, 2] }; // of what is shown
const keys = { ArrowLeft: "earlier", ArrowRight: "later", "+": "in", "=": "in", "-": "out", 0: "whole", Home: "whole" };

/** Move by the name of a button. */
function moveTime(how) {
  if (how === "whole") showTime(...span, null);
  else showTime(...shown.map((time, i) => time + (quarters[how][i] * (shown[1] - shown[0])) / 4));
}

document.addEventListener("keydown", (event) => {
  const isMove = keys[event.key] && event.target.matches(".group .plot");
  if (!isMove || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  moveTime(keys[event.key]);
});

document.addEventListener("click", ({ target }) => {
  const { move, time, run } = target.closest("[data-move], [data-time], [data-run]")?.dataset ?? {};
  if (move) moveTime(move);
  if (time) {
    const half = Math.min((span[1] - span[0]) / 2, Math.max(0.5, (span[1] - span[0]) / 50));
    showTime(Number(time) - half, Number(time) + half, Number(time));
    document.getElementById("tracking").scrollIntoView();
  }
  if (run) {
    hiddenRuns[hiddenRuns.has(Number(run)) ? "delete" : "add"](Number(run));
    for (const each of document.querySelectorAll(`[data-run="${run}"]`)) each.setAttribute("aria-pressed", !hiddenRuns.has(Number(run)));
    redraw();
  }
});

moveTime("whole");

// light and dark: the system's, or the other until the button is pressed again; print is light, and has every drawing

const prefersDark = matchMedia("(prefers-color-scheme: dark)");
const root = document.documentElement.style;
let screenTheme = "";

/** Change the theme: "light", "dark", or the system's. */
function setTheme(theme) {
  [screenTheme, root.colorScheme] = [root.colorScheme, theme];
  redraw();
}

prefersDark.addEventListener("change", redraw);
document.getElementById("theme").addEventListener("click", () => setTheme(root.colorScheme ? "" : prefersDark.matches ? "light" : "dark"));
addEventListener("beforeprint", () => {
  setTheme("light");
  figures.forEach(draw);
});
addEventListener("afterprint", () => setTheme(screenTheme));
