"use strict";
(async () => {
  const unpack = async (id) => {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const [library, figures] = await Promise.all([unpack("library"), unpack("figures").then(JSON.parse)]);
  const script = document.createElement("script");
  script.textContent = library;
  document.head.appendChild(script);

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const colours = (isDark) => isDark ? { ink: "#e6e6e6", rule: "#3a3d41", paper: "#16181a" } : { ink: "#1d1f21", rule: "#d5d8dc", paper: "#ffffff" };
  const look = (layout, isDark) => {
    const { ink, rule, paper } = colours(isDark);
    const change = { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", "font.color": ink, "modebar.bgcolor": "rgba(0,0,0,0)", "modebar.color": rule, "modebar.activecolor": ink, "hoverlabel.bgcolor": paper, "hoverlabel.bordercolor": rule, "hoverlabel.font.color": ink };
    for (const key of Object.keys(layout)) {
      if (/^[xy]axis/.test(key)) Object.assign(change, { [key + ".gridcolor"]: rule, [key + ".zerolinecolor"]: rule, [key + ".linecolor"]: rule });
    }
    (layout.shapes || []).forEach((_, n) => { change[`shapes[${n}].line.color`] = ink; });
    return change;
  };
  const plots = [];
  const paint = (isDark) => Promise.all(plots.map(([box, layout]) => Plotly.relayout(box, look(layout, isDark))));

  for (const figure of figures) {
    const place = document.querySelector(`figure[data-chart="${CSS.escape(figure.key)}"]`);
    const box = place.querySelector(".plot");
    const layout = structuredClone(figure.layout);
    if (box.clientWidth < 560) {
      layout.margin.l = 40;
      for (const trace of figure.data) {
        if (trace.colorbar) Object.assign(trace.colorbar, { orientation: "h", y: 1, yanchor: "bottom", thickness: 8, title: { text: "" }, tickfont: { size: 8 } });
      }
      layout.legend = { orientation: "h", y: 1.0, yanchor: "bottom", x: 0, font: { size: 10 } };
      layout.font = { size: 10 };
    }
    await Plotly.newPlot(box, figure.data, layout, { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"] });
    await Plotly.relayout(box, look(figure.layout, dark.matches));
    plots.push([box, figure.layout]);
    place.dataset.drawn = "yes";
    await new Promise((resolve) => setTimeout(resolve, 0));
  }
  dark.addEventListener("change", () => paint(dark.matches));
  addEventListener("beforeprint", () => paint(false));
  addEventListener("afterprint", () => paint(dark.matches));
  document.body.dataset.drawn = "yes";
})();
