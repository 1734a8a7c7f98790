"use strict";
// What every page shares: its data, colours that follow the theme, plots, tables, copying.
const page = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const all = (selector) => [...document.querySelectorAll(selector)];

function buffer(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes.buffer;
}
const floats = (text) => new Float32Array(buffer(text));
const shares = (text) => new Uint16Array(buffer(text));
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
const said = (value, digits = 3) => (value === null || !isFinite(value) ? "–" : String(Number(value.toPrecision(digits))));

const literal = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;"); // plotly reads tags in its texts

// --- Plots: each is a function that gives {data, layout}; drawn anew when the theme changes.
const plots = new Map();
function baseLayout() {
  const axis = { gridcolor: colour("line"), zerolinecolor: colour("line"), linecolor: colour("line") };
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", margin: { l: 60, r: 20, t: 20, b: 50 },
    font: { color: colour("text"), family: "system-ui, sans-serif", size: 13 }, showlegend: false,
    xaxis: { ...axis }, yaxis: { ...axis }, uirevision: "keep",
    modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("soft"), activecolor: colour("text") },
  };
}
function axes(layout, x, y) {
  Object.assign(layout.xaxis, x);
  Object.assign(layout.yaxis, y);
  return layout;
}
const config = { displaylogo: false, displayModeBar: "hover", responsive: true, plotlyServerURL: "", showSendToCloud: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
function plot(id, make) {
  if (!byId(id)) return;
  plots.set(id, make);
  redraw(id);
}
function redraw(id) {
  const { data, layout } = plots.get(id)();
  return Plotly.react(byId(id), data, layout, config);
}
const redrawAll = () => plots.forEach((_, id) => redraw(id));
let waiting = new Set();
function soon(...ids) { // at most once a frame, however fast a slider moves
  if (!waiting.size) requestAnimationFrame(() => { const now = [...waiting]; waiting.clear(); now.filter((id) => plots.has(id)).forEach(redraw); });
  ids.forEach((id) => waiting.add(id));
}

// --- The theme: the system's, or one of the two.
const themes = ["", "light", "dark"], themeNames = ["as the system", "light", "dark"];
byId("theme").addEventListener("click", () => {
  const next = (themes.indexOf(document.documentElement.dataset.theme || "") + 1) % 3;
  document.documentElement.dataset.theme = themes[next];
  byId("theme").textContent = "Colours: " + themeNames[next];
  redrawAll();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
let shownTheme = "";
addEventListener("beforeprint", () => {
  shownTheme = document.documentElement.dataset.theme || "";
  document.documentElement.dataset.theme = "light";
  all("details").forEach((d) => (d.open = true));
  redrawAll();
});
addEventListener("afterprint", () => { document.documentElement.dataset.theme = shownTheme; redrawAll(); });

// --- Scenes in three dimensions: turned by the mouse, or by the buttons below them.
function sceneLayout() {
  const axis = { gridcolor: colour("line"), color: colour("soft"), backgroundcolor: "rgba(0,0,0,0)", showspikes: false };
  const layout = baseLayout();
  layout.margin = { l: 0, r: 0, t: 0, b: 0 };
  layout.scene = { aspectmode: "data", xaxis: { ...axis, title: { text: "x" } }, yaxis: { ...axis, title: { text: "y" } }, zaxis: { ...axis, title: { text: "z" } },
    camera: { eye: { x: 1.2, y: -1.2, z: 0.95 } }, uirevision: "keep", dragmode: "orbit" };
  return layout;
}
const looks = { top: [0, -1e-3, 1.6], front: [0, -1.6, 0], side: [1.6, 0, 0], slant: [1.2, -1.2, 0.95] };
function turned([x, y, z], how) {
  if (looks[how]) return looks[how];
  let r = Math.hypot(x, y, z), yaw = Math.atan2(y, x), tilt = Math.asin(z / r);
  if (how === "left") yaw -= Math.PI / 12;
  if (how === "right") yaw += Math.PI / 12;
  if (how === "up") tilt = Math.min(tilt + Math.PI / 12, 1.57);
  if (how === "down") tilt = Math.max(tilt - Math.PI / 12, -1.57);
  if (how === "nearer") r /= 1.25;
  if (how === "farther") r *= 1.25;
  return [r * Math.cos(tilt) * Math.cos(yaw), r * Math.cos(tilt) * Math.sin(yaw), r * Math.sin(tilt)];
}
all("[data-turn]").forEach((button) => button.addEventListener("click", () => {
  const div = byId(button.dataset.turn), { x, y, z } = div._fullLayout.scene._scene.getCamera().eye;
  const [a, b, c] = turned([x, y, z], button.dataset.view);
  Plotly.relayout(div, { "scene.camera.eye": { x: a, y: b, z: c }, "scene.camera.center": { x: 0, y: 0, z: 0 } });
}));

// --- Copying, also where the clipboard is closed to a page from a file.
all("[data-copy]").forEach((button) => button.addEventListener("click", async () => {
  const element = byId(button.dataset.copy), said = byId("copied");
  try {
    await navigator.clipboard.writeText(element.textContent.trim() + "\n");
  } catch {
    getSelection().selectAllChildren(element);
    document.execCommand("copy");
  }
  said.textContent = "Copied.";
}));

// --- Tables: sorted by the buttons in their heads, filtered by a text and by statuses.
all("table.sorted").forEach((table) => {
  const body = table.tBodies[0];
  [...table.tHead.rows[0].cells].forEach((cell, column) => {
    const button = cell.querySelector("button");
    if (!button) return;
    button.addEventListener("click", () => {
      const down = cell.getAttribute("aria-sort") === "ascending";
      [...table.tHead.rows[0].cells].forEach((other) => other.removeAttribute("aria-sort"));
      cell.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent.trim();
      const rows = [...body.rows].sort((p, q) => compare(key(p), key(q), down));
      body.append(...rows);
    });
  });
});
function compare(a, b, down) { // what is missing stays last either way
  if (a === "" || b === "") return (a === "") - (b === "");
  const x = Number(a), y = Number(b);
  const order = isNaN(x) || isNaN(y) ? a.localeCompare(b, undefined, { numeric: true }) : x - y;
  return down ? -order : order;
}
all("[data-filter]").forEach((form) => {
  const table = byId(form.dataset.filter), text = form.querySelector("input[type=search]");
  const boxes = [...form.querySelectorAll("input[type=checkbox]")], count = form.querySelector("output");
  const apply = () => {
    const wanted = text.value.trim().toLowerCase(), on = new Set(boxes.filter((b) => b.checked).map((b) => b.value));
    let left = 0;
    [...table.tBodies[0].rows].forEach((row) => {
      const hit = on.has(row.dataset.status) && row.textContent.toLowerCase().includes(wanted);
      row.hidden = !hit;
      left += hit;
    });
    count.textContent = `${left} of ${table.tBodies[0].rows.length} shown`;
  };
  form.addEventListener("input", apply);
  form.addEventListener("submit", (event) => event.preventDefault());
  apply();
});
