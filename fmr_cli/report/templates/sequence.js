"use strict";
// The path over the map, and the frames' residuals and sigmas; a slider goes along the frames.
const rows = page.rows, sure = rows.map((r) => r.status === "aligned");
const frameNow = () => Number(byId("frame").value);
function viewPlot(view) {
  const pick = (list, want, k) => list.map((p, i) => (want(i) ? p[k] : null));
  const line = (points, extra) => ({ type: "scatter", mode: "lines", x: points.map((p) => p && p[0]), y: points.map((p) => p && p[1]), hoverinfo: "skip", ...extra });
  const words = rows.map((r) => literal(`frame ${r.frame}, ${r.file}: ${r.status}${r.unobserved ? `, ${r.unobserved} not observed` : ""}`));
  const dots = (want, look) => ({ type: "scatter", mode: "markers", x: pick(view.xy, want, 0), y: pick(view.xy, want, 1), text: words, hovertemplate: "%{text}<extra></extra>", marker: look });
  const data = [];
  if (view.before) data.push(line(view.before, { line: { color: colour("soft"), width: 1.5, dash: "dot" } }));
  data.push(line(view.xy, { line: { color: colour("good"), width: 2 } }));
  if (page.loops.length) data.push(line(page.loops.flatMap(([a, b]) => [view.xy[a], view.xy[b], null]), { line: { color: colour("series4"), width: 2.5 } }));
  if (page.loops.length) data.push({ type: "scatter", mode: "markers", hoverinfo: "skip", x: page.loops.flat().map((i) => view.xy[i][0]), y: page.loops.flat().map((i) => view.xy[i][1]),
    marker: { size: 10, symbol: "circle-open", color: colour("series4"), line: { width: 2 } } });
  data.push(dots((i) => sure[i], { size: 5, color: colour("good") }));
  data.push(dots((i) => !sure[i], { size: 9, symbol: "triangle-up", color: colour("doubtful"), line: { color: colour("ground"), width: 1 } }));
  const ends = [0, view.xy.length - 1];
  data.push({ type: "scatter", mode: "markers", hoverinfo: "skip", x: ends.map((i) => view.xy[i][0]), y: ends.map((i) => view.xy[i][1]), marker: { size: 13, symbol: ["square-open", "diamond-open"], color: colour("text"), line: { width: 2.5 } } });
  const here = view.xy[frameNow()];
  data.push({ type: "scatter", mode: "markers", hoverinfo: "skip", x: [here[0]], y: [here[1]], marker: { size: 18, symbol: "circle-open", color: colour("text"), line: { width: 3 } } });
  const [[x0, y0], [x1, y1]] = view.box;
  const layout = axes(baseLayout(), { title: { text: view.axes[0] }, range: [x0, x1] }, { title: { text: view.axes[1] }, range: [y0, y1], scaleanchor: "x" });
  layout.hovermode = "closest";
  layout.images = [{ source: view.ground, xref: "x", yref: "y", x: x0, y: y1, sizex: x1 - x0, sizey: y1 - y0, sizing: "stretch", layer: "below" }];
  return { data, layout };
}
function curvesPlot() {
  const series = [["inlier_rmse", "residual"], ["sigma_shift", "sigma, shift"], ["sigma_rotation_deg", "sigma, rotation °"]];
  const layout = baseLayout(), data = [];
  layout.xaxis = { ...layout.xaxis, title: { text: "frame" }, anchor: "y3" };
  series.forEach(([name, title], n) => {
    const axis = n ? `y${n + 1}` : "y", key = n ? `yaxis${n + 1}` : "yaxis", top = 1 - n * 0.345;
    layout[key] = { ...baseLayout().yaxis, title: { text: title }, domain: [top - 0.3, top], rangemode: "tozero" };
    const values = rows.map((r) => r[name]);
    const shared = { type: "scatter", x: rows.map((r) => r.frame), yaxis: axis, text: rows.map((r) => literal(`${r.file}: ${r.status}`)), hovertemplate: "frame %{x}: %{y:.4g}<br>%{text}<extra></extra>" };
    data.push({ ...shared, mode: "lines+markers", y: values, connectgaps: false, line: { color: colour("target"), width: 1.5 }, marker: { size: 4, color: colour("target") } });
    data.push({ ...shared, mode: "markers", y: values.map((v, i) => (sure[i] ? null : v)), marker: { size: 10, symbol: "triangle-up", color: colour("doubtful"), line: { color: colour("ground"), width: 1 } } });
  });
  layout.shapes = [{ type: "line", xref: "x", yref: "paper", x0: rows[frameNow()].frame, x1: rows[frameNow()].frame, y0: 0, y1: 1, line: { color: colour("text"), width: 1, dash: "dot" } }];
  return { data, layout };
}
function tellFrame() {
  const r = rows[frameNow()];
  byId("frame-said").textContent = `${r.frame}, ${r.file}: ${r.status}${r.inlier_rmse === null ? "" : `, residual ${said(r.inlier_rmse)}`}${r.unobserved ? `, ${r.unobserved} not observed` : ""}`;
}
byId("frame").addEventListener("input", () => { tellFrame(); soon("view-0", "view-1", "curves"); });
tellFrame();
page.views.forEach((view, n) => plot(`view-${n}`, () => viewPlot(view)));
plot("curves", curvesPlot);
