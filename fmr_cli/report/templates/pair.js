"use strict";
// Two clouds at a pose that can be chosen, and the residuals there.
page.clouds.forEach((cloud) => (cloud.xyz = floats(cloud.points)));
page.poses.forEach((pose) => { pose.point = shares(pose.point); pose.plane = shares(pose.plane); });
const chosen = () => Number(document.querySelector("input[name=pose]:checked").value);
const placed = page.poses.map(() => null); // the source at each pose, made when it is first shown

// The error up to which errors are told apart: by the scans' own spacing or noise, what is beyond is far off.
const worthTelling = (by) => Math.min(page.limit, Math.max(4 * (by === "plane" ? page.noise : page.spacing), page.voxel / 4));

function shownClouds() {
  const n = chosen(), pose = page.poses[n], by = byId("colouring").value;
  placed[n] ??= moved(page.clouds[1].xyz, pose.matrix);
  const values = by === "file" ? null : pose[by];
  const name = by === "plane" ? "plane error" : "point error", high = worthTelling(by);
  return [
    { name: "target", points: page.clouds[0].xyz, values: null, colour: values ? colour("line") : colour("target") },
    { name: "source", points: placed[n], values, colour: colour("source"), ends: { name, low: 0, high, open: true, top: 65535 * high / page.limit } },
  ];
}
function sceneExtras() { // the directions that are not determined: an arrow each way to shift, a dashed axis to turn about
  const length = page.size / 4, tint = colour("bad");
  return page.arrows.map(({ kind, vector, words }) => {
    const tip = vector.map((v) => v * length), side = across(vector).map((v) => (v * length) / 12);
    const head = (sign) => [[1, -1], [1, 1]].map(([, s]) => tip.map((t, k) => sign * t * 0.85 + s * side[k]));
    const ends = [tip.map((t) => -t), tip];
    const way = kind === "shift" ? [head(-1)[0], ends[0], head(-1)[1], ends[0], ends[1], head(1)[0], ends[1], head(1)[1]] : ends;
    const text = way.map(() => "");
    text[kind === "shift" ? way.length - 1 : 0] = "not determined: " + words;
    return { type: "scatter3d", mode: "lines+text", x: way.map((p) => p[0]), y: way.map((p) => p[1]), z: way.map((p) => p[2]), text, name: words, hoverinfo: "name",
      line: { color: tint, width: 7, dash: kind === "shift" ? "solid" : "dash" }, textfont: { color: tint, size: 14 }, textposition: "top center" };
  });
}
function across([x, y, z]) { // a unit vector at right angles
  const other = Math.abs(z) < 0.9 ? [-y, x, 0] : [0, -z, y], n = Math.hypot(...other);
  return other.map((v) => v / n);
}
const BINS = 60;
function histogramPlot() {
  const by = byId("error").value, pose = page.poses[chosen()];
  const high = worthTelling(by), step = high / BINS;
  const count = new Float64Array(BINS);
  let beyond = 0;
  for (const share of pose[by]) {
    const bin = Math.floor(share / 65535 * page.limit / step);
    if (bin < BINS && share < 65535) count[bin]++;
    else beyond++;
  }
  const percent = Array.from(count, (c) => 100 * c / pose[by].length), top = 1.25 * Math.max(...percent, 1e-9);
  const layout = axes(baseLayout(), { title: { text: by === "point" ? "point error" : "plane error" }, range: [0, high] },
    { title: { text: "% of the source's points" }, range: [0, top] });
  const marks = [["spacing", page.spacing], ["noise", page.noise], ["voxel edge", page.voxel]].filter(([, v]) => v > 0 && v < high).sort((p, q) => p[1] - q[1]);
  layout.shapes = marks.map(([, x]) => ({ type: "line", x0: x, x1: x, y0: 0, y1: 1, yref: "paper", line: { color: colour("text"), width: 1.5, dash: "dash" } }));
  layout.annotations = marks.map(([name, x], n) => ({ x, y: 1 - 0.09 * n, yref: "paper", text: `${name} ${said(x)}`, showarrow: false, xanchor: "left", xshift: 4, bgcolor: colour("ground") }));
  layout.annotations.push({ x: 1, y: 0.72, xref: "paper", yref: "paper", xanchor: "right", showarrow: false, text: `${said(100 * beyond / pose[by].length, 2)} % lie further off`, bgcolor: colour("ground") });
  layout.bargap = 0;
  const middles = Array.from(count, (_, i) => (i + 0.5) * step);
  return { data: [{ type: "bar", x: middles, y: percent, marker: { color: colour("source") }, hovertemplate: "%{x:.3g}: %{y:.2f} %<extra></extra>" }], layout };
}
function tell() {
  const n = chosen(), pose = page.poses[n], e = pose.errors;
  byId("pose-said").textContent = `${pose.name}: ${pose.words}. Overlap of the source ${Math.round(100 * pose.overlap)} %, ` +
    `point error (RMS) ${said(e.point.rms)}, plane error (RMS) ${said(e.plane.rms)}.`;
  byId("matrix-text").textContent = pose.text;
  all("tr[data-pose]").forEach((row) => row.classList.toggle("chosen", Number(row.dataset.pose) === n));
}
all("input[name=pose]").forEach((radio) => radio.addEventListener("change", () => { tell(); soon("scene", "section", "histogram"); }));
byId("colouring").addEventListener("change", () => soon("scene", "section"));
byId("error").addEventListener("change", () => soon("histogram"));
tell();
plot("histogram", histogramPlot);
startClouds();
