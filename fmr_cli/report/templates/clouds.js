"use strict";
// Clouds in three dimensions and a section through them. A page says which clouds: shownClouds() gives
// [{name, points: Float32Array of xyz, values: per-point numbers from 0 to 65535 or null, colour: CSS colour}].
const AXES = ["x", "y", "z"], SECTION_POINTS = 4000; // of each cloud in a section: an SVG stays quick
const scale = [[0, "#245cbe"], [0.25, "#2a8fbd"], [0.5, "#8fc77a"], [0.75, "#f2c14e"], [1, "#c8321f"]]; // few to many
function moved(points, T) {
  const out = new Float32Array(points.length);
  for (let i = 0; i < points.length; i += 3) {
    const x = points[i], y = points[i + 1], z = points[i + 2];
    for (let k = 0; k < 3; k++) out[i + k] = T[k][0] * x + T[k][1] * y + T[k][2] * z + T[k][3];
  }
  return out;
}
function column(points, axis, keep = null) {
  const count = keep ? keep.length : points.length / 3, out = new Float32Array(count);
  for (let i = 0; i < count; i++) out[i] = points[3 * (keep ? keep[i] : i) + axis];
  return out;
}
function marker(cloud, size, keep = null, bar = false) {
  if (cloud.own) return { size, color: keep ? keep.map((i) => cloud.own[i]) : cloud.own, line: { width: 0 } };
  if (!cloud.values) return { size, color: cloud.colour, opacity: 1, line: { width: 0 } };
  const values = keep ? keep.map((i) => cloud.values[i]) : Array.from(cloud.values);
  const ends = cloud.ends, top = (ends && ends.top) || 65535; // the values that 0 and ``top`` stand for, and their name
  return { size, color: values, cmin: 0, cmax: top, colorscale: scale, line: { width: 0 }, showscale: bar && !!ends,
    colorbar: ends && { title: { text: ends.name, side: "right" }, thickness: 12, len: 0.7, tickvals: [0, top / 2, top],
      ticktext: [said(ends.low), said((ends.low + ends.high) / 2), (ends.open ? "≥ " : "") + said(ends.high)] } };
}
function scenePlot() {
  const size = Number(byId("size").value), clouds = shownClouds();
  const withBar = clouds.findIndex((c) => c.values);
  const data = clouds.map((cloud, n) => ({ type: "scatter3d", mode: "markers", name: cloud.name, hoverinfo: "name", x: column(cloud.points, 0), y: column(cloud.points, 1),
    z: column(cloud.points, 2),
    marker: marker(cloud, size, null, n === withBar) }));
  return { data: [...data, ...(window.sceneExtras ? sceneExtras() : [])], layout: sceneLayout() };
}
function bounds(axis) { // of the middle 99.8 %: a stray point would take the slider's length
  let low = Infinity, high = -Infinity;
  for (const cloud of shownClouds()) {
    const sorted = column(cloud.points, axis).sort(), n = sorted.length;
    if (!n) continue;
    low = Math.min(low, sorted[Math.floor(0.001 * (n - 1))]);
    high = Math.max(high, sorted[Math.ceil(0.999 * (n - 1))]);
  }
  return isFinite(low) ? [low, high] : [0, 1];
}
const cut = { axis: 2, at: 0, thick: 1, range: [0, 1] };
function readCut() {
  cut.axis = Number(byId("section-axis").value);
  cut.range = bounds(cut.axis);
  cut.at = cut.range[0] + (cut.range[1] - cut.range[0]) * byId("section-at").value / 1000;
  cut.thick = page.size / 20 * 10 ** (Number(byId("section-thick").value) / 50 - 1.5); // a 600th to a 6th of the size
  byId("section-said").textContent = `${AXES[cut.axis]} = ${said(cut.at, 4)}`;
  byId("thick-said").textContent = said(cut.thick, 2);
}
function sectionPlot() {
  readCut();
  const [a, b] = [0, 1, 2].filter((k) => k !== cut.axis), size = 1.5 + Number(byId("size").value);
  const data = shownClouds().map((cloud) => {
    const keep = [];
    for (let i = 0; i < cloud.points.length / 3 && keep.length < SECTION_POINTS; i++)
      if (Math.abs(cloud.points[3 * i + cut.axis] - cut.at) <= cut.thick / 2) keep.push(i);
    return { type: "scatter", mode: "markers", name: cloud.name, hoverinfo: "name+x+y", x: column(cloud.points, a, keep), y: column(cloud.points, b, keep),
      marker: marker(cloud, size, keep) };
  });
  const layout = axes(baseLayout(), { title: { text: AXES[a] } }, { title: { text: AXES[b] }, scaleanchor: "x" });
  layout.uirevision = `cut along ${cut.axis}`;
  return { data, layout };
}
function startClouds(section = null) { // section: {axis, at, thick} to begin with
  byId("section-axis").value = section ? section.axis : shortestAxis();
  if (section) {
    const [low, high] = bounds(section.axis);
    byId("section-at").value = 1000 * (section.at - low) / (high - low || 1);
    byId("section-thick").value = 50 * (Math.log10(section.thick * 20 / page.size) + 1.5);
  }
  ["section-axis", "section-at", "section-thick"].forEach((id) => byId(id).addEventListener("input", () => soon("section")));
  byId("size").addEventListener("input", () => soon("scene", "section"));
  plot("section", sectionPlot);
  plot("scene", scenePlot);
}
function shortestAxis() { // a room is cut level, through all its walls
  const sizes = [0, 1, 2].map((axis) => { const [low, high] = bounds(axis); return high - low; });
  return sizes[2] < 1.3 * Math.min(...sizes) ? 2 : sizes.indexOf(Math.min(...sizes));
}
