"use strict";
(async () => {
  // a page saved from a browser says what was drawn there
  for (const place of document.querySelectorAll("[data-drawn]")) delete place.dataset.drawn;

  const unpack = async (id) => {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const [library, figures] = await Promise.all([unpack("library"), unpack("figures").then(JSON.parse)]);
  const script = document.createElement("script");
  script.textContent = library;
  document.head.appendChild(script);

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);
  const look = (layout) => {
    const [ink, rule, paper] = ["--ink", "--rule", "--paper"].map(colour);
    const change = { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", "font.color": ink, "modebar.bgcolor": "rgba(0,0,0,0)", "modebar.color": rule, "modebar.activecolor": ink, "hoverlabel.bgcolor": paper, "hoverlabel.bordercolor": rule, "hoverlabel.font.color": ink };
    for (const key of Object.keys(layout)) {
      if (/^[xy]axis/.test(key)) Object.assign(change, { [key + ".gridcolor"]: rule, [key + ".zerolinecolor"]: rule, [key + ".linecolor"]: rule });
    }
    (layout.shapes || []).forEach((_, n) => { change[`shapes[${n}].line.color`] = ink; });
    return change;
  };

  const plots = [];
  for (const figure of figures) {
    const place = document.querySelector(`figure[data-chart="${CSS.escape(figure.key)}"]`);
    const box = place.querySelector(".plot");
    place.dataset.drawn = "yes"; // the library measures the box, so that it must be shown by now
    const layout = structuredClone(figure.layout);
    if (box.clientWidth < 560) {
      layout.margin.l = 40;
      for (const trace of figure.data) {
        if (trace.colorbar) Object.assign(trace.colorbar, { orientation: "h", y: 1, yanchor: "bottom", thickness: 8, title: { text: "" }, tickfont: { size: 8 } });
      }
      layout.legend = { orientation: "h", y: 1.0, yanchor: "bottom", x: 0, font: { size: 10 } };
      layout.font = { size: 10 };
    }
    try {
      await Plotly.newPlot(box, figure.data, layout, { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"] });
      await Plotly.relayout(box, look(figure.layout));
    } catch (fault) {
      delete place.dataset.drawn; // the image stays
      throw fault;
    }
    plots.push([box, figure.layout]);
    await new Promise((resolve) => setTimeout(resolve, 0));
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const [box, layout] of plots) Plotly.relayout(box, look(layout));
  });
  document.body.dataset.drawn = "yes";
})();
