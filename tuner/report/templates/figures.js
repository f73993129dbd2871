"use strict";
// Draws charts into the figures of a page, or of a part of it, that bear their keys; needs d3 and Plot.
const drawFigures = (charts, root = document) => {
  const NARROW = 560; // px
  const DASHES = { solid: null, dot: "1.5,3", dash: "6,4" };
  const number = (value) => +value.toPrecision(5);
  const decades = (low, high) => {
    const [first, last] = [Math.floor(Math.log10(low)), Math.ceil(Math.log10(high))];
    const steps = high < 30 * low ? [1, 2, 5] : [1];
    const ticks = d3.range(first, last + 1, Math.ceil((last - first) / 8)).flatMap((power) => steps.map((step) => step * 10 ** power));
    return { ticks: ticks.filter((at) => at > 0.999 * low && at < 1.001 * high), tickFormat: (at) => (at < 0.9e-3 ? at.toExponential(0) : String(+at.toPrecision(3))) };
  };
  const whole = (low, high) => [10 ** Math.floor(Math.log10(low)), 10 ** Math.ceil(Math.log10(high))];
  const placesOf = (labels, width) => ({ domain: [-0.5, labels.length - 0.5], ticks: d3.range(0, labels.length, Math.ceil((90 * labels.length) / width)), tickFormat: (at) => labels[at] });
  const lettersOf = (labels) => d3.max(labels, (label) => label.length) ?? 0;

  const ofLine = (line, log) => {
    const { look } = line;
    const points = line.x.map((x, n) => ({ x, y: log && line.y[n] <= 0 ? null : line.y[n], text: line.text[n] }));
    for (const point of points) if (point.y !== null) point.text ??= `${line.name}: ${number(point.y)} at ${number(point.x)}`;
    const known = points.filter((point) => point.y !== null && point.x !== null);
    const marks = [];
    if (line.joined) marks.push(Plot.line(points, { x: "x", y: "y", clip: true, stroke: look.colour, strokeWidth: look.width, strokeDasharray: DASHES[look.dash] }));
    if (look.marks || !line.joined) marks.push(Plot.dot(known, { x: "x", y: "y", clip: true, fill: look.colour, r: 3 }));
    return { known, marks };
  };

  const ofLines = (panel, { width, height, margins, view }) => {
    const drawn = panel.marks.map((line) => ofLine(line, panel.y_scale === "log"));
    const known = drawn.flatMap((each) => each.known);
    const isTiny = panel.y_scale === "linear" && d3.max(known, (point) => Math.abs(point.y)) < 1e-3;
    let [across, up] = [view?.x, view?.y];
    if (panel.equal && !view) {
      const [x, y] = ["x", "y"].map((axis) => d3.extent(known, (point) => point[axis]));
      const [w, h] = [width - margins.marginLeft - margins.marginRight, height - margins.marginTop - margins.marginBottom];
      const scale = 1.05 * Math.max((x[1] - x[0]) / w, (y[1] - y[0]) / h);
      [across, up] = [[x, w], [y, h]].map(([[low, high], size]) => [(low + high - scale * size) / 2, (low + high + scale * size) / 2]);
    }
    return {
      x: { type: panel.x_scale, ...(panel.x_labels.length && placesOf(panel.x_labels, width)), ...(panel.x_scale === "log" && decades(...(across ?? d3.extent(known, (point) => point.x)))), ...(across && { domain: across }) },
      y: { type: panel.y_scale, ...(panel.y_scale === "log" && decades(...whole(...d3.extent(known, (point) => point.y)))), nice: !up, ...(up && { domain: up }), ...(panel.y_scale === "linear" && height < 200 && { ticks: 4 }), ...(isTiny && { tickFormat: (at) => number(at).toExponential() }) },
      marks: [
        Plot.ruleY(panel.levels, { y: "0", strokeDasharray: "4,3" }),
        Plot.text(panel.levels, { y: "0", text: "1", frameAnchor: "right", dy: -7 }),
        ...drawn.flatMap((each) => each.marks),
        Plot.tip(known, Plot.pointer({ x: "x", y: "y", title: "text" })),
      ],
    };
  };

  const ofBars = (panel) => {
    const log = panel.x_scale === "log";
    const bars = panel.marks.flatMap((mark) => mark.labels.map((label, n) => ({ label, value: mark.values[n], colour: mark.colour, text: mark.text[n] ?? `${label}: ${number(mark.values[n] ?? 0)}` })));
    const known = bars.filter((bar) => bar.value !== null && (!log || bar.value > 0));
    const least = d3.min(known, (bar) => bar.value) / 2;
    const across = log ? { x1: () => least, x2: "value" } : { x: "value" };
    return {
      x: { type: panel.x_scale, ...(log && decades(least, d3.max(known, (bar) => bar.value))) },
      y: { type: "band", domain: panel.marks[0].labels },
      marks: [Plot.barX(known, { ...across, y: "label", fill: "colour", title: "text", tip: true })],
    };
  };

  const ofHeat = (heat, narrow) => {
    const cells = heat.rows.flatMap((row, n) => heat.columns.map((column, m) => ({ row, column, value: heat.values[n][m], text: heat.text[n]?.[m].replaceAll("<br>", "\n") })));
    const color = heat.diverging
      ? { type: "diverging", scheme: "RdBu", reverse: true, domain: [-1, 1] }
      : { type: "linear", scheme: "cividis", domain: d3.extent(cells, (cell) => cell.value) };
    const shade = Plot.scale({ color });
    const ticks = Object.keys(heat.ticks).map(Number).filter((at) => at >= color.domain[0] && at <= color.domain[1]);
    const words = typeof heat.columns[0] === "string";
    const marks = [Plot.cell(cells, { x: "column", y: "row", fill: "value", title: "text", inset: heat.digits === null ? 0 : 0.5, tip: heat.text.length > 0 })];
    if (heat.digits !== null && !narrow) {
      const ink = (cell) => (d3.lab(shade.apply(cell.value)).l < 60 ? "white" : "black");
      marks.splice(1, 0, Plot.text(cells.filter((cell) => cell.value !== null), { x: "column", y: "row", text: (cell) => cell.value.toFixed(heat.digits), fill: ink, fontSize: 9 }));
    }
    return {
      color,
      legend: { color: { ...color, label: heat.bar }, ...(ticks.length > 1 && { ticks, tickFormat: (at) => heat.ticks[at] ?? heat.ticks[at.toFixed(1)] }), marginLeft: 14, marginRight: 14, width: narrow ? 220 : 300 },
      x: { type: "band", domain: heat.columns, tickRotate: words ? -50 : 0, ticks: words ? undefined : heat.columns.filter((_, n) => n % Math.ceil(heat.columns.length / 8) === 0), tickFormat: words ? undefined : (at) => at.toFixed(0) },
      y: { type: "band", domain: heat.rows },
      marks,
    };
  };

  const views = {}; // clock, or key of a chart that shares none -> the ranges that are shown
  const drawn = new Map(); // place -> what draws it again
  const clockOf = (chart) => chart.clock || chart.key;
  const show = (chart, view) => {
    views[clockOf(chart)] = view;
    for (const [place, redraw] of drawn) if (clockOf(byKey[place.dataset.chart]) === clockOf(chart)) redraw();
  };

  const zoomed = (svg, chart, panel, { width, height, margins }) => {
    const [x, y] = ["x", "y"].map((axis) => svg.scale(axis));
    const brush = (panel.equal ? d3.brush() : d3.brushX()).touchable(false); // a finger scrolls
    brush.extent([[margins.marginLeft, margins.marginTop], [width - margins.marginRight, height - margins.marginBottom]]);
    brush.on("end", ({ selection }) => {
      if (!selection) return;
      const [[left, top], [right, bottom]] = panel.equal ? selection : [[selection[0]], [selection[1]]];
      show(chart, { x: [x.invert(left), x.invert(right)], ...(panel.equal && { y: [y.invert(bottom), y.invert(top)] }) });
    });
    d3.select(svg).append("g").call(brush);
    svg.addEventListener("dblclick", () => show(chart, undefined));
  };

  const panelOf = (chart, n, width, hidden) => {
    const narrow = width < NARROW;
    const last = n === chart.panels.length - 1;
    const panel = { ...chart.panels[n], marks: chart.panels[n].marks.filter((mark) => !hidden.has(mark.name)) };
    const first = chart.panels[n].marks[0] ?? {}; // nothing acts along this axis
    const labels = first.rows ?? first.labels ?? [];
    const letters = first.rows && typeof first.columns[0] === "string" ? lettersOf(first.columns) : 0;
    const margins = {
      marginLeft: labels.length ? Math.min(0.46 * width, 12 + (narrow ? 5.5 : 6.2) * lettersOf(labels)) : narrow ? 44 : 60,
      marginRight: 14,
      marginTop: labels.length ? 6 : 24,
      marginBottom: last ? 40 + 4.5 * letters : 8,
    };
    const height = Math.round((chart.height - 40) / chart.panels.length) + (last && n ? 32 : 0);
    const { legend, x, y, color, marks } = !panel.marks.length ? { marks: [] } : first.look ? ofLines(panel, { width, height, margins, view: views[clockOf(chart)] }) : first.labels ? ofBars(panel) : ofHeat(first, narrow);
    const svg = Plot.plot({
      width,
      height,
      ...margins,
      style: { fontSize: narrow ? "9px" : "11px" },
      color,
      x: { ...x, axis: last ? "bottom" : null, grid: !first.rows, label: chart.x_title || null, labelAnchor: "center", labelArrow: "none", ...(first.labels && narrow && panel.x_scale === "linear" && { ticks: 4 }) },
      y: { ...y, grid: !labels.length, label: panel.y_title || null, labelArrow: "none" },
      marks,
    });
    if (first.look && marks.length) zoomed(svg, chart, panel, { width, height, margins });
    return [...(legend ? [Plot.legend(legend)] : []), svg];
  };

  const legendOf = (chart, hidden, redraw) => {
    const marks = new Map(chart.panels.flatMap((panel) => panel.marks).filter((mark) => mark.name).map((mark) => [mark.name, mark]));
    const legend = document.createElement("div");
    legend.className = "legend";
    for (const [name, { look, colour }] of marks.size > 1 ? marks : []) {
      const button = document.createElement("button");
      button.innerHTML = '<svg width="22" height="10"><line x2="22" y1="5" y2="5"/></svg>';
      const stroke = { stroke: look?.colour ?? colour, "stroke-width": look?.width ?? 8, "stroke-dasharray": DASHES[look?.dash] ?? "none" };
      for (const [key, value] of Object.entries(stroke)) button.querySelector("line").setAttribute(key, value);
      button.append(name);
      button.setAttribute("aria-pressed", !hidden.has(name));
      button.onclick = () => {
        if (!hidden.delete(name)) hidden.add(name);
        redraw();
      };
      legend.append(button);
    }
    const download = document.createElement("button");
    download.textContent = "Save as SVG";
    download.className = "save";
    legend.append(download);
    return legend;
  };

  const save = (box, chart) => {
    const figure = d3.create("svg").attr("font-family", "system-ui, sans-serif").attr("font-size", 12);
    let y = 22;
    figure.append("text").attr("x", 8).attr("y", 15).text(chart.title);
    for (const button of box.querySelectorAll(".legend [aria-pressed=true]")) {
      const mark = figure.append("g").attr("transform", `translate(8 ${y})`);
      mark.append(() => button.querySelector("svg").cloneNode(true));
      mark.append("text").attr("x", 28).attr("y", 9).text(button.textContent);
      y += 16;
    }
    for (const panel of box.querySelectorAll(":scope > svg")) {
      const copy = panel.cloneNode(true);
      copy.setAttribute("y", y);
      figure.append(() => copy);
      y += +panel.getAttribute("height");
    }
    figure.attr("width", box.clientWidth).attr("height", y);
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([new XMLSerializer().serializeToString(figure.node())], { type: "image/svg+xml" }));
    link.download = `${chart.key}.svg`;
    link.click();
    URL.revokeObjectURL(link.href);
  };

  const byKey = Object.fromEntries(charts.map((chart) => [chart.key, chart]));
  const draw = (place) => {
    const chart = byKey[place.dataset.chart];
    const box = place.querySelector(".plot");
    const hidden = new Set();
    let width = 0;
    const redraw = () => {
      width = box.clientWidth;
      if (!width) return; // folded again
      const legend = legendOf(chart, hidden, redraw);
      legend.querySelector(".save").onclick = () => save(box, chart);
      box.replaceChildren(legend, ...chart.panels.flatMap((_, n) => panelOf(chart, n, width, hidden)));
    };
    redraw();
    new ResizeObserver(() => box.clientWidth !== width && redraw()).observe(box);
    drawn.set(place, redraw);
    place.dataset.drawn = "yes";
  };
  const watch = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      watch.unobserve(target);
      draw(target);
    }
  }, { rootMargin: "400px" });
  for (const place of root.querySelectorAll("figure[data-chart]")) {
    place.querySelector(".plot").style.setProperty("--height", `${byKey[place.dataset.chart].height}px`);
    watch.observe(place);
  }
};
