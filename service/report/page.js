// The page of a run, from a log or live: plots, attitude in 3-D, events and one cursor over all of them.
// A page of a log has its columns in itself; console.js appends columns as they are received.
"use strict";

const { span, times, drawings, period, numbers, live } = JSON.parse(document.getElementById("data").textContent);
const plots = [...document.querySelectorAll(".plot")];
const pointed = matchMedia("(pointer: fine)").matches || !matchMedia("(any-pointer: coarse)").matches;
const dark = matchMedia("(prefers-color-scheme: dark)");
const options = { displayModeBar: false, responsive: true, doubleClick: false, showTips: false };
const MARGIN = { l: 78, r: 10 }; // of every drawing, as in drawings.py [px]
let shown = [...span]; // by every time axis [s]
let cursor = null; // time that 3-D and readings show [s]
let round = 0; // of drawing everything
let following = live; // whether what is shown moves on with what is received
let preview = []; // traces of an approach that is only considered
let eventLines = []; // shapes of events that came while the page was open

const runTimes = times.map(() => []); // of each run [s]
for (const { data } of Object.values(drawings)) for (const line of data) line.y = [];

/** Unpack times and lines of a log's page. */
async function unpack() {
  const letters = atob(numbers);
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) packed[i] = letters.charCodeAt(i); // `from` takes ten times as long
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const octets = await new Response(stream).arrayBuffer();
  let at = 0;
  times.forEach((count, run) => {
    runTimes[run] = new Float64Array(octets, at, count);
    at += 8 * count;
  });
  for (const { data } of Object.values(drawings)) {
    for (const line of data) {
      line.y = new Float32Array(octets, at, times[line.times]);
      at += 4 * times[line.times];
    }
  }
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

/** Index of the last time of a run that is not after another; −1 where there is none. */
const lastAt = (run, time) => {
  const after = firstAt(runTimes[run], time + 1e-9);
  return after - 1;
};

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

// ── colours: those of the style sheet; lines are lighter on a dark page ──

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

function onPage(hex) {
  if (!dark.matches || !/^#[0-9a-f]{6}$/i.test(hex)) return hex;
  const parts = [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  return `rgb(${parts.map((part) => Math.round(part + (255 - part) * 0.42)).join(",")})`;
}

function coloured(layout) {
  const grid = colour("grid");
  const view = { ...layout, paper_bgcolor: colour("paper"), plot_bgcolor: colour("paper"),
    font: { ...layout.font, color: colour("quiet"), family: getComputedStyle(document.body).fontFamily } };
  for (const name of Object.keys(layout).filter((each) => /^[xy]axis/.test(each))) {
    const axis = layout[name];
    view[name] = { ...axis, gridcolor: grid, zerolinecolor: colour("rule"),
      title: { ...axis.title, font: { color: colour("ink") } } };
  }
  return view;
}

// ── plots ──

/** Draw a figure, or draw it again at another time; `size` is its width and height on paper [px]. */
function draw(plot, size = {}) {
  const { data, layout } = drawings[plot.dataset.name];
  const isFirst = plot.data === undefined;
  if (isFirst) plot.replaceChildren(); // of a page that a browser saved with its drawings
  const traces = data.map((line) => {
    const width = Math.max(300, plot.clientWidth - MARGIN.l - MARGIN.r);
    const { isReduced, ...points } = inView(runTimes[line.times], line.y, width);
    const stroke = { ...line.line, color: onPage(line.line.color), shape: isReduced ? "linear" : line.line.shape };
    return { ...line, ...points, line: stroke };
  });
  if (plot.dataset.name === "angles") traces.push(...preview);
  const view = { ...coloured(layout), ...size, dragmode: pointed && !live ? "zoom" : false };
  view.xaxis = { ...view.xaxis, range: [...shown] };
  view.shapes = [...(layout.shapes ?? []), ...eventLines];
  Plotly.react(plot, traces, view, options);
  placeCursor(plot);
  if (!isFirst) return;
  plot.on("plotly_relayout", (change) => {
    if ("xaxis.range[0]" in change) showTime(change["xaxis.range[0]"], change["xaxis.range[1]"]);
  });
  plot.on("plotly_doubleclick", () => showTime(...span));
  plot.addEventListener("pointermove", ({ clientX }) => {
    const at = timeAt(plot, clientX - plot.getBoundingClientRect().left);
    if (!playing && !following && at !== null) moveCursor(at);
  });
}

/** Draw everything for the first time, what is in sight first; the body says when all of it is drawn. */
async function begin() {
  if (!live) await unpack();
  moveCursor(Math.max(0, span[0]));
  await redraw();
  if (!live) linked();
  document.body.dataset.drawn = "";
}

/** The time under a horizontal place of a plot; null beside its axes. */
function timeAt(plot, x) {
  const width = plot.clientWidth - MARGIN.l - MARGIN.r;
  const share = (x - MARGIN.l) / width;
  return share < 0 || share > 1 ? null : shown[0] + share * (shown[1] - shown[0]);
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
function showTime(from, to) {
  const [start, end] = span;
  const width = Math.min(Math.max(to - from, Math.min((end - start) / 10, 0.002)), end - start);
  const middle = Math.min(Math.max((from + to) / 2, start + width / 2), end - width / 2);
  shown = [middle - width / 2, middle + width / 2];
  redraw();
}

// ── the cursor: one instant over plots, 3-D, readings and events ──

const seeker = document.getElementById("seek");
const readings = document.getElementById("readings");
const marks = [...document.querySelectorAll("#events [data-time]")];

function placeCursor(plot) {
  let line = plot.querySelector(":scope > .cursor");
  if (line === null) plot.append((line = Object.assign(document.createElement("i"), { className: "cursor" })));
  const share = cursor === null ? -1 : (cursor - shown[0]) / (shown[1] - shown[0]);
  line.hidden = share < 0 || share > 1;
  line.style.left = `${MARGIN.l + share * (plot.clientWidth - MARGIN.l - MARGIN.r)}px`;
}

/** Show an instant [s] everywhere. */
function moveCursor(time) {
  cursor = Math.min(Math.max(time, span[0]), span[1]);
  plots.forEach(placeCursor);
  if (seeker) seeker.value = String(cursor);
  showAttitude(cursor);
  showReadings();
  let latest = null;
  for (const mark of marks) {
    const isPast = Number(mark.dataset.time) <= cursor;
    mark.closest("tr")?.classList.toggle("past", isPast);
    if (isPast) latest = mark;
  }
  for (const mark of marks) mark.closest("tr")?.classList.toggle("now", mark === latest);
}

/** Values of a group of panels at the cursor: [panel, quantity, value] each, of a run. */
function valuesOf(group, run) {
  const found = [];
  const at = lastAt(run, cursor);
  for (const line of drawings[group]?.data ?? []) {
    if (line.times === run && at >= 0) found.push([line.panel, line.quantity, line.y[at], line.unit]);
  }
  return found;
}

function showReadings() {
  if (!readings || cursor === null) return;
  const rows = [[`${cursor.toFixed(3)} s`, period ? `tick ${Math.floor(cursor / period + 1e-6)}` : "", ""]];
  for (const group of ["angles", "error_angle", "input", "latency"]) {
    const panels = new Map();
    for (const [panel, quantity, value, unit] of valuesOf(group, 0)) {
      panels.set(panel, { ...panels.get(panel), [quantity]: `${Number.isFinite(value) ? value.toFixed(2) : "–"} ${unit}` });
    }
    for (const [panel, { desired = "", true: _, ...found }] of panels) {
      rows.push([group === "error_angle" ? "error" : panel, Object.values(found)[0] ?? "–", desired]);
    }
  }
  readings.replaceChildren(...rows.map((cells) => {
    const row = document.createElement("tr");
    row.append(...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
    return row;
  }));
}

// ── playing ──

const player = document.getElementById("play");
const speed = document.getElementById("speed");
let playing = 0; // time of the last frame [ms]; 0 while it stands

function play(frame) {
  if (!playing) return;
  const time = cursor + ((frame - playing) / 1000) * Number(speed.value);
  playing = frame;
  if (time >= span[1]) return pause();
  if (time > shown[1]) showTime(time, time + shown[1] - shown[0]);
  moveCursor(time);
  requestAnimationFrame(play);
}

function pause() {
  playing = 0;
  player.textContent = "▶";
  player.setAttribute("aria-label", "Play");
  if (!live && cursor !== null) history.replaceState(null, "", `#t=${cursor.toFixed(3)}`);
}

function toggle() {
  if (playing) return pause();
  if (cursor === null || cursor >= span[1]) moveCursor(Math.max(span[0], 0));
  player.textContent = "❚❚";
  player.setAttribute("aria-label", "Pause");
  playing = performance.now();
  requestAnimationFrame(play);
}

/** Go to an instant [s]: the cursor, the plots around it, and the link to it. */
function goTo(time, half = Math.min((span[1] - span[0]) / 2, Math.max(0.5, (span[1] - span[0]) / 50))) {
  showTime(time - half, time + half);
  moveCursor(time);
  pause();
}

function step(ticks) {
  moveCursor((cursor ?? 0) + ticks * (period || 0.01));
  if (cursor < shown[0] || cursor > shown[1]) showTime(cursor - (shown[1] - shown[0]) / 2, cursor + (shown[1] - shown[0]) / 2);
  pause();
}

/** Go to the instant in the address, if it has one: #t=12.34. */
function linked() {
  const found = /^#t=([\d.]+)$/.exec(location.hash);
  if (found) goTo(Number(found[1]));
}

const moves = { earlier: [-1, -1], later: [1, 1], in: [1, -1], out: [-2, 2] }; // in quarters of what is shown

document.addEventListener("click", ({ target }) => {
  const { move, time, step: ticks } = target.closest("[data-move], [data-time], [data-step]")?.dataset ?? {};
  if (move === "whole") showTime(...span);
  else if (move) showTime(...shown.map((each, i) => each + (moves[move][i] * (shown[1] - shown[0])) / 4));
  if (ticks) step(Number(ticks));
  if (time) {
    goTo(Number(time));
    document.getElementById("tracking").scrollIntoView();
  }
});

if (!live) {
  player?.addEventListener("click", toggle);
  seeker?.addEventListener("input", () => moveCursor(Number(seeker.value)));
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("input, select, button, a, summary, [tabindex]") || event.ctrlKey || event.metaKey) return;
    const ticks = { ArrowLeft: -1, ArrowRight: 1 }[event.key] * (event.shiftKey ? Math.round(1 / (period || 0.01)) : 1);
    if (event.key === " ") toggle();
    else if (ticks) step(ticks);
    else return;
    event.preventDefault();
  });
  addEventListener("hashchange", linked);
}

dark.addEventListener("change", () => (redraw(), showAttitude(cursor)));
addEventListener("resize", () => (plots.forEach(placeCursor), showAttitude(cursor)));
addEventListener("beforeprint", () => {
  for (const plot of plots) draw(plot, { width: 465, height: 60 + 100 * plot.dataset.panels, autosize: false });
});
addEventListener("afterprint", () => {
  plots.forEach(Plotly.purge); // which forgets the size on paper
  redraw();
});
