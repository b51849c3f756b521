// The console: appends what its socket brings to the page's columns, shows states and events, and asks for an operator.
"use strict";

const LAST = 60; // seconds of columns that are shown
const { vehicle, generation } = document.body.dataset;
const readsOnly = "readsOnly" in document.body.dataset;
const columns = JSON.parse(document.getElementById("columns").textContent); // [group, panel, quantity] each
const lines = columns.map(([group, panel, quantity]) =>
  drawings[group].data.find((line) => line.panel === panel && line.quantity === quantity));
const find = (id) => document.getElementById(id);
const [roles, happened] = ["vehicles", "events"].map((id) => document.querySelector(`#${id} tbody`));
let socket = null;
let session = ""; // of the columns
let statuses = {}; // by vehicle and role, as received
let received = performance.now(); // the last block [ms]
let measured = performance.now(); // the last rows were received [ms]
let drawnAt = 0; // the plots were [ms]
let asked = 0; // requests so far

const element = (name, text, more = {}) => Object.assign(document.createElement(name), { textContent: text, ...more });

// ── columns ──

function append(block) {
  const instants = runTimes[0];
  if (block.session !== session) {
    session = block.session;
    instants.length = 0;
    for (const line of lines) line.y.length = 0;
    eventLines = [];
  }
  if (block.rows?.length) measured = performance.now();
  for (const [time, ...values] of block.rows ?? []) {
    instants.push(time);
    lines.forEach((line, i) => line.y.push(values[i] ?? NaN));
  }
  const extra = firstAt(instants, instants.at(-1) - LAST);
  if (extra > 200) {
    instants.splice(0, extra);
    for (const line of lines) line.y.splice(0, extra);
  }
  if (!instants.length) return;
  [span[0], span[1]] = [Math.max(instants[0], instants.at(-1) - LAST), instants.at(-1)];
  if (!following || performance.now() - drawnAt < 250) return;
  drawnAt = performance.now();
  moveCursor(span[1]);
  showTime(span[1] - LAST, span[1]);
}

// ── states and events ──

const digits = (value, places) => (value === undefined || value === null ? "–" : Number(value).toFixed(places));

function showStatuses() {
  const since = (performance.now() - received) / 1000;
  const rows = [];
  for (const [name, its] of Object.entries(statuses).sort()) {
    for (const role of [...new Set([...Object.keys(its), "controller", "plant"])].sort()) {
      const status = its[role];
      const row = document.createElement("tr");
      const address = new URLSearchParams(location.search);
      address.set("vehicle", name);
      const link = element("a", name, { href: `?${address}` });
      row.append(document.createElement("td"), ...[role, status?.state ?? "missing", digits(status && status.age_s + since, 1),
        digits(status?.rate_hz, 0), digits(status?.skipped, 0), status?.latency_us?.map((us) => us.toFixed(0)).join("/") ?? "–",
        [status?.cause, ...(status?.faults ?? []), ...(status?.notes ?? [])].filter(Boolean).join("; ")].map((text) => element("td", text)));
      row.firstChild.append(link);
      row.className = !status || status.age_s + since > 3 ? "quiet" : /tripped|faulted/.test(status.state) ? "bad" : "";
      rows.push(row);
    }
  }
  roles.replaceChildren(...rows);
  const own = statuses[vehicle] ?? {};
  const gone = socket?.readyState !== WebSocket.OPEN || since > 2;
  find("state").textContent = headline(own.plant, since);
  showAge((performance.now() - measured) / 1000);
  find("link").textContent = gone ? `no link for ${since.toFixed(0)} s` : readsOnly ? "linked, reads only" : "linked";
  document.body.classList.toggle("gone", gone);
  find("instead").hidden = !gone;
  find("operate").disabled = gone || readsOnly;
  for (const button of document.querySelectorAll("button.stop")) button.disabled = gone || readsOnly;
  showGains(own.controller?.gains ?? {});
}

/** The plant's state; without a status for 3 s it may be another one by now. */
function headline(plant, since) {
  if (!plant) return "no plant";
  const age = plant.age_s + since;
  return age > 3 ? `silent for ${age.toFixed(0)} s, last ${plant.state}` : plant.state;
}

/** Say how old the newest attitude is: without a session, as after a trip, none is measured. */
function showAge(age) {
  const isOld = age > 2;
  const stage = document.querySelector(".stage");
  stage.classList.toggle("old", isOld);
  stage.querySelector("th.number").textContent = isOld ? `last known, ${age.toFixed(0)} s ago` : "now";
}

function showGains(gains) {
  const fields = find("gains");
  for (const [name, values] of Object.entries(gains)) {
    let field = fields.querySelector(`[name="${CSS.escape(name)}"]`);
    if (!field) {
      const label = element("label", `${name} `);
      label.append((field = element("input", "", { name })));
      fields.append(label);
    }
    field.placeholder = values.join(" ");
  }
}

function showEvents(events) {
  for (const { at, vehicle: name, role, kind, text, tick, session: its } of events) {
    const isGrave = /tripped|fault|lost|refused/.test(kind);
    if (name === vehicle && its === session && tick !== null) {
      eventLines.push({ type: "line", x0: tick * period, x1: tick * period, y0: 0, y1: 1, yref: "paper", layer: "below",
        line: { color: colour(isGrave ? "bad" : "quiet"), width: 1.2, dash: isGrave ? "solid" : "dot" } });
      eventLines = eventLines.slice(-40);
    }
    const row = document.createElement("tr");
    row.append(...[new Date(at * 1000).toLocaleTimeString(), name, role, kind, text].map((each) => element("td", each)));
    row.lastChild.className = "text";
    if (isGrave) row.children[3].className = "kind grave";
    happened.prepend(row);
  }
  while (happened.children.length > 200) happened.lastChild.remove();
}

// ── an operator's requests ──

function ask(verb, more = {}) {
  if (socket?.readyState !== WebSocket.OPEN) return;
  socket.send(JSON.stringify({ number: ++asked, verb, vehicle, ...more }));
  if (verb !== "preview") report(asked, `${verb}: asked`, "quiet");
}

/** Show what a request came to, in its own place. */
function report(number, text, kind) {
  const list = find("answers");
  let line = list.querySelector(`[data-number="${number}"]`);
  if (!line) list.prepend((line = element("li", "")));
  line.dataset.number = number;
  line.textContent = `${new Date().toLocaleTimeString()} ${text}`;
  line.className = kind;
  while (list.children.length > 6) list.lastChild.remove();
}

function answered({ number, verb, text, answers = [], failures = [], failed, within_s: within, path }) {
  if (verb === "preview") return showPreview(failed, within, path);
  const wrong = [...failures, ...(failed ? [failed] : [])];
  report(number, `${verb}: ${[text, ...answers, ...wrong].filter(Boolean).join("; ")}`, wrong.length ? "bad" : "good");
}

function showPreview(failed, within, path) {
  const wanted = Number(document.querySelector("[data-verb=goto] [name=within]").value) || Infinity;
  find("preview").textContent = failed ?? (wanted < within ? `too short: it takes ${within} s at least` : `shortest ${within} s`);
  find("preview").className = failed || wanted < within ? "bad" : "quiet";
  const axes = { roll: "y", pitch: "y2", yaw: "y3" };
  preview = failed ? [] : Object.values(axes).map((yaxis, i) => ({ type: "scatter", mode: "lines", name: "previewed", yaxis,
    x: path.t.map((t) => span[1] - within + t), y: path.angles[i], showlegend: i === 0, hoverinfo: "skip",
    line: { color: onPage("#009e73"), width: 2, dash: "dot" } }));
  redraw();
}

const values = (form) => Object.fromEntries(new FormData(form));
const angles = ({ roll, pitch, yaw }) => [roll, pitch, yaw].map(Number);
const requests = {
  arm: () => ask("arm"),
  release: () => ask("release"),
  mark: ({ text }) => ask("mark", { text }),
  track: ({ what }) => ask("track", { what }),
  inject: ({ fault }) => ask("inject", { fault }),
  gains: (given) => ask("gains", { gains: Object.fromEntries(Object.entries(given).filter(([, text]) => text.trim())
    .map(([name, text]) => [name, text.trim().split(/[\s,]+/).map(Number)])) }),
  goto: (given) => {
    preview = [];
    ask("goto", { attitude: angles(given), within_s: given.within ? Number(given.within) : null });
  },
};

document.addEventListener("submit", (event) => {
  event.preventDefault();
  requests[event.target.dataset.verb](values(event.target));
  if (event.target.dataset.verb === "mark") event.target.reset();
});
document.addEventListener("click", ({ target }) => {
  const button = target.closest("button[data-verb]");
  if (button?.dataset.verb === "stop") ask("stop", { vehicle: button.dataset.vehicle });
  if (button?.dataset.verb === "clear") ask("inject", { fault: "" });
});
document.querySelector("[data-verb=goto]").addEventListener("input", ({ currentTarget }) => {
  const given = values(currentTarget);
  if ([given.roll, given.pitch, given.yaw].every((each) => each !== "")) ask("preview", { attitude: angles(given) });
});
find("follow").addEventListener("click", ({ currentTarget }) => {
  following = !following;
  currentTarget.textContent = following ? "Pause" : "Follow";
  currentTarget.setAttribute("aria-pressed", String(following));
});

// ── the socket ──

function connect() {
  const address = new URL("socket", location.href);
  address.search = location.search;
  address.searchParams.set("vehicle", vehicle);
  address.protocol = location.protocol.replace("http", "ws");
  socket = new WebSocket(address);
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "answer") return answered(message);
    if (message.generation !== undefined && String(message.generation) !== generation) return location.reload();
    [statuses, received] = [message.vehicles, performance.now()];
    find("troubles").replaceChildren(...message.troubles.map(({ text }) => element("li", text, { className: "bad" })));
    append(message);
    showEvents(message.events);
    showStatuses();
    socket.send('{"verb":"shown"}');
  };
  socket.onclose = () => setTimeout(connect, 1000);
}

setInterval(showStatuses, 500); // ages run on without a link, too
connect();
