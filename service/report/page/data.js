// Data of the page: arrays from base64, colours from the style sheet, numbers as text.

const data = JSON.parse(document.getElementById("data").textContent);
const several = data.runs.length > 1;
const pointed = matchMedia("(pointer: fine)").matches || !matchMedia("(any-pointer: coarse)").matches;

/** Little-endian floats out of base64. */
function floats(text, Type) {
  return new Type(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
}

for (const run of data.runs) run.time = floats(run.time, Float64Array);
for (const group of data.groups)
  for (const panel of group.panels)
    for (const line of panel.lines) {
      line.y = floats(line.values, Float32Array);
      line.x = data.runs[line.run].time;
      if (line.sparse) {
        // Published less often than every tick: missing values are not gaps.
        line.x = line.x.filter((_, i) => !Number.isNaN(line.y[i]));
        line.y = line.y.filter((value) => !Number.isNaN(value));
      }
      delete line.values;
    }

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

/** A key beside a drawing's title: what each colour means. */
function showKey(figure, entries) {
  const items = entries.map(([name, line, dash]) => {
    const item = document.createElement("span");
    const swatch = document.createElement("i");
    swatch.className = `swatch ${dash ?? ""}`;
    swatch.style.setProperty("--line", `var(${line})`);
    item.append(swatch, name);
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
