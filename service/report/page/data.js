// Data of the page: lines unpacked, colours from the style sheet, numbers as text.

const data = JSON.parse(document.getElementById("data").textContent);
const several = data.runs.length > 1;
const pointed = matchMedia("(pointer: fine)").matches || !matchMedia("(any-pointer: coarse)").matches;

/** Numbers as `packed` of data.py wrote them. */
async function unpack({ least, step, deltas }, Type) {
  const bytes = Uint8Array.from(atob(deltas), (letter) => letter.charCodeAt(0));
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(inflated).arrayBuffer());
  const n = planes.length / 4;
  const values = new Type(n);
  for (let i = 0, code = 0; i < n; i++) {
    const zigzag = planes[i] | (planes[n + i] << 8) | (planes[2 * n + i] << 16) | (planes[3 * n + i] << 24);
    code += (zigzag >>> 1) ^ -(zigzag & 1);
    values[i] = code < 0 ? NaN : least + step * code;
  }
  return values;
}

async function unpackLine(line) {
  line.y = await unpack(line.values, Float32Array);
  line.x = data.runs[line.run].time;
  if (line.sparse) {
    // Published less often than every tick: missing values are not gaps.
    line.x = line.x.filter((_, i) => !Number.isNaN(line.y[i]));
    line.y = line.y.filter((value) => !Number.isNaN(value));
  }
  delete line.values;
}

/** Fulfilled when every line can be drawn. */
const unpacked = (async () => {
  for (const run of data.runs) run.time = await unpack(run.time, Float64Array);
  await Promise.all(data.groups.flatMap(({ panels }) => panels.flatMap(({ lines }) => lines.map(unpackLine))));
})();

/** A number with a true minus sign. */
const signed = (text) => text.replace("-", "−");

/** A colour of the style sheet as the present theme has it, such as `--ink`. */
function colour(name) {
  const probe = document.createElement("i");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
}

/** Text escaped for plotly, which interprets a few tags. */
function plain(text) {
  return text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
}

/** A duration given in µs, with the unit that suits it. */
function duration(us) {
  const [scale, unit] = us >= 1e6 ? [1e6, "s"] : us >= 1e3 ? [1e3, "ms"] : [1, "µs"];
  return `${Number((us / scale).toPrecision(3))} ${unit}`;
}

/** Ticks of a logarithmic axis of durations [µs], from one exponent of ten to another. */
function durationTicks(from, to) {
  const room = innerWidth < 600 ? 1.2 : 2.5; // decades whose ticks do not overlap
  const digits = to - from > 2 * room ? [1] : to - from > room ? [1, 3] : [1, 2, 5];
  const tickvals = [];
  for (let power = Math.floor(from); power <= to; power++) tickvals.push(...digits.map((digit) => digit * 10 ** power));
  return { tickvals, ticktext: tickvals.map(duration) };
}

const RUN_DASHES = ["solid", "7px,2px", "2px,2px", "9px,2px,2px,2px", "14px,3px", "4px,4px", "12px,2px,2px,2px,2px,2px"];

/** How the lines of a run are drawn among several: the first is widest and lies below, so that none hides another. */
function runStroke(run) {
  const width = 1.1 + (1.9 * (data.runs.length - 1 - run)) / Math.max(1, data.runs.length - 1);
  return { color: colour(`--run-${run % 8}`), width, dash: RUN_DASHES[run % RUN_DASHES.length] };
}

const hiddenRuns = new Set();

/** A key beside a drawing's title: what each colour means. The entry of a run hides and shows it in every drawing. */
function showKey(figure, entries) {
  const items = entries.map(([name, line, dash, run]) => {
    const item = document.createElement(run === undefined ? "span" : "button");
    const swatch = document.createElement("i");
    swatch.className = `swatch ${dash ?? ""}`;
    swatch.style.setProperty("--line", `var(${line})`);
    item.append(swatch, name);
    if (run !== undefined) {
      item.type = "button";
      item.dataset.run = run;
      item.setAttribute("aria-pressed", !hiddenRuns.has(run));
      item.title = "Hide or show this run in every drawing";
    }
    return item;
  });
  figure.querySelector(".key").replaceChildren(...items);
}

/** What every drawing has in common. */
function plainLayout() {
  const ink = colour("--ink");
  return {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: colour("--quiet") },
    showlegend: false,
    hoverlabel: { bgcolor: colour("--raised"), bordercolor: colour("--rule"), font: { color: ink, size: 12 }, namelength: -1 },
    annotations: [],
    shapes: [],
  };
}

const plotOptions = { displayModeBar: false, responsive: true, doubleClick: false, showTips: false };
