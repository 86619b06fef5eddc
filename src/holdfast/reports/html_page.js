"use strict";
// Draws each chart as wide as its place. A chart of two columns has one on a narrow screen.
const charts = JSON.parse(document.getElementById("charts").textContent);
const places = [...document.querySelectorAll("[data-chart]")];

const eachView = (view, change) => {
  change(view);
  for (const key of ["concat", "hconcat", "vconcat", "layer"]) {
    for (const inner of view[key] || []) eachView(inner, change);
  }
};

const draw = (place) => {
  const spec = structuredClone(charts[Number(place.dataset.chart)]);
  const { labels: fixed, letters, widest = 170 } = spec.usermeta || {};
  const limit = place.clientWidth < 500 ? 105 : widest;
  spec.config.axis.labelLimit = limit;
  const labels = fixed || 75 + Math.min(limit, 7 * letters);
  const columns = spec.columns === 2 && place.clientWidth >= 820 ? 2 : 1;
  if (spec.columns) spec.columns = columns;
  if (place.clientWidth < 500) spec.config.legend.columns = 1;
  const width = Math.max(150, Math.floor(place.clientWidth / columns) - labels);
  eachView(spec, (view) => {
    const { aspect } = view.usermeta || {};
    if (aspect) view.height = Math.round(Math.min(aspect * width, 520));
    if (aspect) view.width = Math.round(view.height / aspect);
    else if (view.mark || view.layer) view.width = width;
  });
  return vegaEmbed(place, spec, { mode: "vega-lite", renderer: "svg", actions: false, tooltip: { theme: "light" } });
};

let drawnWidth = window.innerWidth;
const drawAll = () => Promise.all(places.map(draw));
window.drawn = drawAll();
window.addEventListener("resize", () => {
  if (Math.abs(window.innerWidth - drawnWidth) < 30) return;  // a phone's bar comes and goes
  drawnWidth = window.innerWidth;
  window.drawn = drawAll();
});
