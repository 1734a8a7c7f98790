"use strict";
// Clouds of one frame, coloured by file, by their own colours or by a number of each point.
const hues = ["target", "source", "series3", "series4", "series5", "series6"];
page.clouds.forEach((cloud) => {
  cloud.xyz = floats(cloud.points);
  for (const name of Object.keys(cloud.values)) cloud.values[name] = shares(cloud.values[name]);
  if (cloud.rgb) {
    const bytes = new Uint8Array(buffer(cloud.rgb));
    cloud.rgb = Array.from({ length: bytes.length / 3 }, (_, i) => `rgb(${bytes[3 * i]},${bytes[3 * i + 1]},${bytes[3 * i + 2]})`);
  }
});
function shownClouds() {
  const by = byId("colouring").value, on = new Set(all("input[name=cloud]:checked").map((box) => Number(box.value)));
  return page.clouds.map((cloud, n) => ({ name: literal(cloud.name), points: cloud.xyz, colour: colour(hues[n % hues.length]), own: by === "rgb" ? cloud.rgb : null,
    values: cloud.values[by] || null, ends: page.scales[by] })).filter((_, n) => on.has(n));
}
const keys = () => all(".key[data-cloud]").forEach((key) => key.style.setProperty("--dot", `var(--${hues[key.dataset.cloud % hues.length]})`));
keys();
byId("colouring").addEventListener("change", () => soon("scene", "section"));
all("input[name=cloud]").forEach((box) => box.addEventListener("change", () => soon("scene", "section")));
startClouds(page.section);
