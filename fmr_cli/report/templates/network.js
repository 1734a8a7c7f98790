"use strict";
// Scans from above with their links, and all placed scans together.
const LOOK = { aligned: ["good", "solid"], placed: ["good", "solid"], known: ["good", "solid"], uncertain: ["doubtful", "dot"], rejected: ["bad", "dash"], failed: ["bad", "dash"] };
const SHAPE = { placed: "circle", unplaced: "triangle-up", failed: "x" };
function networkPlot() {
  const data = [];
  if (page.ground) {
    const xy = floats(page.ground), x = [], y = [];
    for (let i = 0; i < xy.length; i += 2) { x.push(xy[i]); y.push(xy[i + 1]); }
    data.push({ type: "scatter", mode: "markers", x, y, marker: { size: 2, color: colour("line") }, hoverinfo: "skip" });
  }
  const drawn = page.links.filter((l) => page.nodes[l.source].xy && page.nodes[l.target].xy);
  const order = ["failed", "rejected", "uncertain", "aligned"]; // the sure ones on top
  for (const status of order) {
    const here = drawn.filter((l) => l.status === status), [tint, dash] = LOOK[status];
    if (!here.length) continue;
    const x = [], y = [];
    here.forEach((l) => { const a = page.nodes[l.source].xy, b = page.nodes[l.target].xy; x.push(a[0], b[0], null); y.push(a[1], b[1], null); });
    data.push({ type: "scatter", mode: "lines", x, y, line: { color: colour(tint), width: status === "aligned" ? 2.5 : 1.5, dash }, hoverinfo: "skip" });
    const middle = (k) => here.map((l) => (page.nodes[l.source].xy[k] + page.nodes[l.target].xy[k]) / 2);
    data.push({ type: "scatter", mode: "markers", x: middle(0), y: middle(1), marker: { size: 9, color: colour(tint), opacity: 0.01 }, customdata: here.map((l) => l.id),
      text: here.map((l) => literal(l.words)), hovertemplate: "%{text}<extra></extra>" });
  }
  const nodes = page.nodes.filter((n) => n.xy);
  data.push({ type: "scatter", mode: nodes.length <= 60 ? "markers+text" : "markers", x: nodes.map((n) => n.xy[0]), y: nodes.map((n) => n.xy[1]), text: nodes.map((n) => literal(n.label)), textposition: "top center",
    hovertext: nodes.map((n) => literal(n.words)), hovertemplate: "%{hovertext}<extra></extra>",
    marker: { size: 11, symbol: nodes.map((n) => SHAPE[n.status] || "circle"), color: nodes.map((n) => colour((LOOK[n.status] || ["doubtful"])[0])), line: { color: colour("ground"), width: 1.5 } } });
  const layout = axes(baseLayout(), { title: { text: page.axes[0] } }, { title: { text: page.axes[1] }, scaleanchor: "x" });
  layout.hovermode = "closest";
  return { data, layout };
}
plot("network", networkPlot);
if (byId("network")) byId("network").on("plotly_click", ({ points }) => {
  const row = points[0].customdata && byId(points[0].customdata);
  if (!row) return;
  all("tr.chosen").forEach((other) => other.classList.remove("chosen"));
  row.classList.add("chosen");
  row.scrollIntoView({ block: "center" });
});

if (page.clouds && page.clouds.length) {
  page.clouds.forEach((cloud) => (cloud.xyz = floats(cloud.points)));
  const hues = ["series1", "series2", "series3", "series4", "series5", "series6"];
  window.shownClouds = () => {
    const only = byId("only").value, component = Number(byId("component").value);
    const here = page.clouds.map((c, n) => ({ ...c, n })).filter((c) => c.component === component);
    return here.map((c, k) => ({ name: literal(c.name), points: c.xyz, values: null,
      colour: only === "" ? colour(hues[k % hues.length]) : colour(Number(only) === c.n ? "source" : "target") }))
      .sort((p, q) => (p.colour === colour("source")) - (q.colour === colour("source")));
  };
  byId("only").addEventListener("change", () => {
    if (byId("only").value !== "") byId("component").value = page.clouds[byId("only").value].component;
    soon("scene", "section");
  });
  byId("component").addEventListener("change", () => { byId("only").value = ""; soon("scene", "section"); });
  startClouds();
}
