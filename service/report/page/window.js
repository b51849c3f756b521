// The span of time that every time axis shows: one for all, moved by buttons, keys, drawings and events.

const timeWindow = {
  whole: data.span,
  shown: [...data.span],
  marked: null, // an event that was jumped to
  followers: [],
};

/** Show a span of time everywhere; what lies outside the run is left out. */
function showTime(from, to, marked = timeWindow.marked) {
  const [start, end] = timeWindow.whole;
  const least = Math.min((end - start) / 10, 0.002);
  const width = Math.min(Math.max(to - from, least), end - start);
  const middle = Math.min(Math.max((from + to) / 2, start + width / 2), end - width / 2);
  timeWindow.shown = [middle - width / 2, middle + width / 2];
  timeWindow.marked = marked;
  printTime();
  for (const follow of timeWindow.followers) follow();
}

/** Show what is around an event. */
function showAround(time) {
  const [start, end] = timeWindow.whole;
  const half = Math.min((end - start) / 2, Math.max(0.5, (end - start) / 50));
  showTime(time - half, time + half, time);
}

/** Move by the name of a button or a key. */
function moveTime(how) {
  const [from, to] = timeWindow.shown;
  const width = to - from;
  if (how === "whole") showTime(...timeWindow.whole, null);
  if (how === "earlier") showTime(from - width / 4, to - width / 4);
  if (how === "later") showTime(from + width / 4, to + width / 4);
  if (how === "in") showTime(from + width / 4, to - width / 4);
  if (how === "out") showTime(from - width / 2, to + width / 2);
}

function printTime() {
  const [from, to] = timeWindow.shown;
  const digits = Math.min(3, Math.max(0, 2 - Math.floor(Math.log10(to - from))));
  document.getElementById("shown").value = signed(`${from.toFixed(digits)} – ${to.toFixed(digits)} s`);
}

const moves = { ArrowLeft: "earlier", ArrowRight: "later", "+": "in", "=": "in", "-": "out", 0: "whole", Home: "whole" };

function moveByKey(event) {
  const how = moves[event.key];
  if (!how || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  moveTime(how);
}

for (const button of document.querySelectorAll("[data-move]"))
  button.addEventListener("click", () => moveTime(button.dataset.move));

printTime();
