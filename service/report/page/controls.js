// Interaction: drawing of what is in sight, jumps to events, theme, search, printing.

const figures = [...document.querySelectorAll(".drawing")];
const inSight = new Set();
const upToDate = new Set();

const draw = (figure) => unpacked.then(() => (figure.classList.contains("group") ? drawGroup(figure) : drawSpread(figure)));

/** Draw what is in sight and not up to date, once before the next frame. */
function refresh() {
  refresh.pending ??= requestAnimationFrame(() => {
    refresh.pending = null;
    for (const figure of inSight) if (!upToDate.has(figure)) (upToDate.add(figure), draw(figure));
  });
}

const watcher = new IntersectionObserver(
  (changes) => {
    for (const { target, isIntersecting } of changes) inSight[isIntersecting ? "add" : "delete"](target);
    refresh();
  },
  { rootMargin: "400px" },
);
for (const figure of figures) watcher.observe(figure);

timeWindow.followers.push(() => {
  for (const figure of figures) if (figure.classList.contains("group")) upToDate.delete(figure);
  refresh();
});

function redrawAll() {
  upToDate.clear();
  refresh();
}

// jumps

document.addEventListener("click", ({ target }) => {
  const jump = target.closest(".jump");
  if (!jump) return;
  showAround(Number(jump.dataset.time));
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  document.getElementById("tracking").scrollIntoView({ behavior: calm ? "auto" : "smooth" });
});

// runs hidden and shown

document.addEventListener("click", ({ target }) => {
  const entry = target.closest(".key [data-run]");
  if (!entry) return;
  const run = Number(entry.dataset.run);
  hiddenRuns[hiddenRuns.has(run) ? "delete" : "add"](run);
  for (const each of document.querySelectorAll(`.key [data-run="${run}"]`)) each.setAttribute("aria-pressed", !hiddenRuns.has(run));
  redrawAll();
});

// light and dark: the system's, or the other until the button is pressed again

const prefersDark = matchMedia("(prefers-color-scheme: dark)");
prefersDark.addEventListener("change", redrawAll);
document.getElementById("theme").addEventListener("click", () => {
  const { style } = document.documentElement;
  style.colorScheme = style.colorScheme ? "" : prefersDark.matches ? "light" : "dark";
  redrawAll();
});

// search

const search = document.getElementById("search");
search.addEventListener("input", () => {
  const wanted = search.value.trim().toLowerCase();
  for (const table of document.querySelectorAll("details.keys")) {
    let found = 0;
    for (const row of table.querySelectorAll("[data-key]")) {
      const here = row.dataset.key.includes(wanted) || row.textContent.toLowerCase().includes(wanted);
      row.hidden = !here;
      found += here;
    }
    table.hidden = !found;
    table.open = Boolean(wanted && found);
  }
});

// printing: light, everything drawn, everything open

let screenTheme = "";
addEventListener("beforeprint", () => {
  screenTheme = document.documentElement.style.colorScheme;
  document.documentElement.style.colorScheme = "light";
  for (const figure of figures) draw(figure);
});
addEventListener("afterprint", () => {
  document.documentElement.style.colorScheme = screenTheme;
  redrawAll();
});
