"use strict";
(async () => {
  for (const place of document.querySelectorAll("[data-drawn]")) {
    delete place.dataset.drawn; // of a page that was saved from a browser
    place.querySelector(".plot")?.replaceChildren();
  }
  const open = () => {
    const place = document.getElementById(location.hash.slice(1));
    if (place?.localName === "details") place.open = true;
  };
  addEventListener("hashchange", open);
  open();

  const unpack = async (id) => {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  await new Promise((resolve) => setTimeout(resolve, 0)); // the text first
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
  const range = {}; // clock -> the stretch that its charts show
  const shown = (layout, span) => Object.fromEntries(Object.keys(layout).filter((key) => /^xaxis/.test(key)).flatMap((key) => (span ? [[key + ".range", span]] : [[key + ".autorange", true]])));
  const draw = async (place, figure) => {
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
    await Plotly.newPlot(box, figure.data, layout, { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"], toImageButtonOptions: { format: "svg", filename: figure.key } });
    await Plotly.relayout(box, look(figure.layout));
    if (figure.clock) {
      if (range[figure.clock]) await Plotly.relayout(box, shown(layout, range[figure.clock]));
      box.on("plotly_relayout", (change) => {
        const of = Object.keys(change).find((key) => /^xaxis\d*\.(range|autorange)/.test(key));
        if (!of || box.dataset.follows) return;
        const axis = of.split(".")[0];
        const span = of.includes("autorange") ? null : (change[axis + ".range"] ?? [change[axis + ".range[0]"], change[axis + ".range[1]"]]);
        range[figure.clock] = span;
        for (const other of plots) {
          if (other.box === box || other.figure.clock !== figure.clock) continue;
          other.box.dataset.follows = "yes";
          Plotly.relayout(other.box, shown(other.figure.layout, span)).then(() => delete other.box.dataset.follows);
        }
      });
    }
    plots.push({ box, figure });
    place.dataset.drawn = "yes";
  };

  const figure = Object.fromEntries(figures.map((each) => [each.key, each]));
  const watch = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      watch.unobserve(target);
      draw(target, figure[target.dataset.chart]);
    }
  }, { rootMargin: "400px" });
  for (const place of document.querySelectorAll("figure[data-chart]")) watch.observe(place);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const { box, figure } of plots) Plotly.relayout(box, look(figure.layout));
  });
  document.body.dataset.ready = "yes";
})();
