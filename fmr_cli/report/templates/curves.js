"use strict";
// Lines with their names at their ends, and 95 % intervals where there are some.
const HUES = ["series1", "series2", "series3", "series4", "series5", "series6"], SIGNS = ["circle", "square", "triangle-up", "diamond", "triangle-down", "cross"], DASHES = ["solid", "dash", "dot", "dashdot"];
function curvePlot(spec) {
  const layout = axes(baseLayout(), { title: { text: spec.x }, type: spec.xlog ? "log" : "linear" }, { title: { text: spec.y }, type: spec.log ? "log" : "linear" });
  if (spec.range) layout.yaxis.range = spec.range;
  layout.margin.r = 20 + 7 * Math.min(26, Math.max(0, ...spec.series.map((s) => s.name.length)));
  const data = spec.series.map((s, n) => ({ type: "scatter", mode: spec.steps ? "lines" : "lines+markers", name: literal(s.name), x: s.at, y: s.values,
    line: { color: colour(HUES[n % HUES.length]), dash: DASHES[n % DASHES.length], width: 2, shape: spec.steps ? "hv" : "linear" },
    marker: { symbol: SIGNS[n % SIGNS.length], size: 7 },
    error_y: s.high ? { type: "data", symmetric: false, array: s.high.map((v, i) => v - s.values[i]), arrayminus: s.low.map((v, i) => s.values[i] - v), thickness: 1, width: 2 } : undefined,
    hovertemplate: `%{x}: %{y:.4g}<extra>${literal(s.name).replace(/%/g, "&#37;")}</extra>` }));
  // Names at the ends, moved apart where they would meet.
  const height = byId("plot-0-0") ? byId("plot-0-0").clientHeight - 70 : 250, flat = spec.series.flatMap((s) => s.values).filter((v) => v !== null);
  const to = (v) => (spec.log ? Math.log10(v) : v), low = spec.range ? spec.range[0] : to(Math.min(...flat)), high = spec.range ? spec.range[1] : to(Math.max(...flat));
  const ends = spec.series.map((s, n) => ({ n, name: s.name, y: s.values.at(-1) })).filter((e) => e.y !== null && e.y !== undefined).sort((p, q) => p.y - q.y);
  let last = -Infinity;
  layout.annotations = ends.map((e) => {
    const wanted = (height * (to(e.y) - low)) / (high - low || 1), place = Math.max(wanted, last + 15);
    last = place;
    return { x: 1, xref: "paper", y: to(e.y), yshift: place - wanted, text: literal(e.name.length > 26 ? e.name.slice(0, 25) + "…" : e.name), showarrow: false, xanchor: "left", xshift: 6,
      font: { color: colour(HUES[e.n % HUES.length]), size: 12 } };
  });
  return { data, layout };
}
page.groups.forEach((group, g) => group.plots.forEach((spec, k) => plot(`plot-${g}-${k}`, () => curvePlot(spec))));
