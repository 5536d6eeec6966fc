"use strict";
(() => {
  const PAGE = 50; // rows of closures shown at once
  const data = JSON.parse(document.getElementById("data").textContent);
  const root = document.documentElement;
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const drawn = new Map(); // chart's element: its figure
  const marks = new Map(); // chart's element: what marks the chosen closure on it

  const theme = () => root.dataset.theme ?? (dark.matches ? "dark" : "light");
  const make = (name, text = "", options = {}) => Object.assign(document.createElement(name), { textContent: text }, options);
  const number = (value) => {
    if (value === null) return "–";
    if (typeof value === "string") return value.replace("inf", "∞");
    const notation = value !== 0 && Math.abs(value) < 1e-4 ? "scientific" : "standard";
    return value.toLocaleString("en", { maximumSignificantDigits: 4, notation });
  };

  // Charts

  /** The figure in the colours of a theme. */
  function paint(figure, name) {
    const colours = data.palette[name];
    const traces = figure.data.map((trace) => {
      if (trace.meta === "grid") return { ...trace, colorscale: data.gridScales[name] };
      const colour = colours[trace.meta];
      if (!colour) return trace;
      const marker = { ...trace.marker, color: colour, line: { ...trace.marker?.line, color: trace.marker?.symbol === "circle" ? colours.ground : colour } };
      return { ...trace, line: { ...trace.line, color: colour }, marker, fillcolor: colour };
    });
    const axis = { gridcolor: colours.line, linecolor: colours.line, tickcolor: colours.line };
    const shapes = (figure.layout.shapes ?? []).map((shape) => ({ ...shape, line: { ...shape.line, color: colours[shape.name] } }));
    const layout = {
      ...figure.layout,
      shapes,
      paper_bgcolor: colours.ground,
      plot_bgcolor: colours.ground,
      font: { color: colours.text, size: 12.5, family: getComputedStyle(document.body).fontFamily },
      xaxis: { ...figure.layout.xaxis, ...axis },
      yaxis: { ...figure.layout.yaxis, ...axis },
      hoverlabel: { bgcolor: colours.ground, bordercolor: colours.text, font: { color: colours.ink } },
    };
    return { data: traces, layout };
  }

  function draw(element, figure) {
    const painted = paint(figure, theme());
    drawn.set(element, figure);
    const options = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { scale: 2 } };
    return Plotly.react(element, painted.data, painted.layout, options);
  }

  const waiting = new Map(); // chart's element: what draws it
  const seen = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach((entry) => drawNow(entry.target)), { rootMargin: "300px" });

  function drawWhenSeen(element, figure, after = () => {}) {
    if (!element || !figure) return;
    waiting.set(element, () => draw(element, figure).then(after));
    seen.observe(element);
  }

  function drawNow(element) {
    const start = waiting.get(element);
    waiting.delete(element);
    seen.unobserve(element);
    start?.();
  }

  function retheme() {
    document.getElementById("theme").textContent = theme() === "dark" ? "Light theme" : "Dark theme";
    for (const [element, figure] of drawn) draw(element, figure).then(() => marks.get(element)?.());
  }

  document.getElementById("theme").addEventListener("click", () => {
    root.dataset.theme = theme() === "dark" ? "light" : "dark";
    retheme();
  });
  dark.addEventListener("change", retheme);
  addEventListener("beforeprint", () => [...waiting.keys()].forEach(drawNow));

  // Views

  function readViews(views) {
    if (!views) return () => null;
    const bytes = Uint8Array.from(atob(views.pixels), (letter) => letter.charCodeAt(0));
    const row = new Map(views.steps.map((step, k) => [step, k]));
    const size = views.rows * views.columns;
    return (step) => (row.has(step) ? bytes.subarray(row.get(step) * size, (row.get(step) + 1) * size) : null);
  }

  function showView(element, pixels, views, step) {
    element.classList.toggle("none", !pixels);
    if (!pixels) {
      element.replaceChildren(step < 0 ? "in the run before this one" : "not kept");
      return;
    }
    const canvas = make("canvas", "", { width: views.columns, height: views.rows });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `View at step ${step}, ${views.shape[0]} × ${views.shape[1]} pixels`);
    const context = canvas.getContext("2d", { willReadFrequently: true });
    const image = context.createImageData(views.columns, views.rows);
    pixels.forEach((value, k) => image.data.set([value, value, value, 255], 4 * k));
    context.putImageData(image, 0, 0);
    element.replaceChildren(canvas);
  }

  // Loop closures of one run

  function kindOf(verdict) {
    return verdict === "accepted" ? "accepted" : verdict === "not accepted" ? "refused" : "other";
  }

  function startClosures(article, run) {
    const part = (selector) => article.querySelector(selector);
    const { closures, views } = run;
    const column = Object.fromEntries(closures.evidence.map((each) => [each.name, each.values]));
    const viewOf = readViews(views);
    const every = closures.verdicts.map((_, k) => k);
    const truth = closures.apart.some((value) => value !== null);
    const columns = [
      ["times, s", (k) => closures.times[k].map(number).join(" and ")],
      ...["posterior", "log_ratio", "sequence", "weight"].filter((name) => column[name]).map((name) => [name.replace("_", " "), (k) => number(column[name][k])]),
      ...(truth ? [["apart in truth, m", (k) => number(closures.apart[k])]] : []),
    ];
    let shown = every, first = 0, chosen = -1;

    function filters() {
      const counts = new Map();
      for (const verdict of closures.verdicts) counts.set(verdict, (counts.get(verdict) ?? 0) + 1);
      const found = [[`all ${every.length.toLocaleString("en")}`, () => every]];
      for (const [verdict, count] of counts) found.push([`${verdict}, ${count.toLocaleString("en")}`, () => every.filter((k) => closures.verdicts[k] === verdict)]);
      if (column.sequence) {
        const heads = new Map(every.map((k) => [column.sequence[k], k]).reverse());
        const rows = [...heads.values()].sort((a, b) => a - b);
        found.push([`the first of each sequence, ${rows.length}`, () => rows]);
      }
      return found;
    }

    function row(k) {
      const [earlier, later] = closures.steps[k];
      const line = make("tr", "", { className: k === chosen ? "chosen" : "" });
      const button = make("button", `${earlier} and ${later}`, { type: "button", className: "closure" });
      button.dataset.closure = k;
      button.setAttribute("aria-pressed", String(k === chosen));
      button.setAttribute("aria-label", `Closure of steps ${earlier} and ${later}, ${closures.verdicts[k]}`);
      const head = make("th", "", { scope: "row" });
      head.append(button);
      line.append(head, make("td", closures.verdicts[k], { className: `verdict-cell ${kindOf(closures.verdicts[k])}` }));
      for (const [, text] of columns) line.append(make("td", text(k), { className: "number" }));
      return line;
    }

    function showPage() {
      const rows = shown.slice(first, first + PAGE);
      part("tbody").replaceChildren(...rows.map(row));
      const total = shown.length.toLocaleString("en");
      part(".range").textContent = shown.length ? `${(first + 1).toLocaleString("en")}–${(first + rows.length).toLocaleString("en")} of ${total}` : "none";
      part(".back").disabled = first === 0;
      part(".forward").disabled = first + PAGE >= shown.length;
    }

    function select(k) {
      chosen = k;
      if (!shown.includes(k)) {
        part(".filter").value = "0";
        shown = every;
      }
      const at = shown.indexOf(k);
      if (at < first || at >= first + PAGE) {
        first = PAGE * Math.floor(at / PAGE);
        showPage();
      }
      for (const button of article.querySelectorAll(".closure")) {
        const here = Number(button.dataset.closure) === k;
        button.setAttribute("aria-pressed", String(here));
        button.closest("tr").classList.toggle("chosen", here);
        if (here) reveal(button.closest("tr"));
      }
      part(".previous").disabled = at === 0;
      part(".next").disabled = at === shown.length - 1;
      showPanel(k);
      mark(k);
    }

    /** Scrolls the table, but not the page, to a row. */
    function reveal(line) {
      const box = part(".closures .scroll"), head = part(".closures thead").offsetHeight;
      const top = line.offsetTop - head, bottom = line.offsetTop + line.offsetHeight - box.clientHeight;
      box.scrollTop = Math.max(bottom, Math.min(top, box.scrollTop));
    }

    function showPanel(k) {
      const [earlier, later] = closures.steps[k];
      part(".chosen").textContent = `Steps ${earlier} and ${later}: ${closures.verdicts[k]}.`;
      for (const [name, step, when] of [["earlier", earlier, closures.times[k][0]], ["later", later, closures.times[k][1]]]) {
        showView(part(`.view.${name}`), viewOf(step), views, step);
        part(`.${name}-caption`).textContent = `step ${step}${when === null ? "" : `, ${number(when)} s`}`;
      }
      const reduced = views && (views.rows !== views.shape[0] || views.columns !== views.shape[1]);
      const shownAs = [reduced ? `at ${views.rows} × ${views.columns}` : "", views?.gain > 1.05 ? `${number(views.gain)} times as bright` : ""].filter(Boolean);
      part(".views-note").textContent = views ? `Views of ${views.shape.join(" × ")} pixels${shownAs.length ? `, shown ${shownAs.join(", ")}` : ""}.` : "The run kept no views.";
      const facts = closures.evidence.map((each) => [each.label, number(each.values[k])]);
      if (truth) facts.push(["apart in truth, m", number(closures.apart[k])]);
      part(".evidence").replaceChildren(...facts.flatMap(([label, value]) => [make("dt", label), make("dd", value)]));
    }

    const map = part('[data-chart="map"]');

    /** Marks the chosen closure on the map, once that is drawn: both its ends and the line between them. */
    function mark(k) {
      const find = (trace) => (trace.customdata ? Array.prototype.indexOf.call(numbers(trace.customdata), k) : -1);
      const place = map.data?.findIndex((trace) => find(trace) >= 0) ?? -1;
      if (place < 0) return;
      const trace = map.data[place];
      const lines = map.layout.shapes.filter((shape) => shape.type === "path");
      const path = lines.find((shape) => shape.legendgroup === trace.legendgroup).path; // a piece for each mark
      const ends = path.split("M")[1 + find(trace)].split("L").map((end) => end.split(",").map(Number));
      const around = (end, radius, colour, width) => ({ type: "circle", xsizemode: "pixel", ysizemode: "pixel", xanchor: ends[end][0], yanchor: ends[end][1], x0: -radius, x1: radius, y0: -radius, y1: radius, line: { color: colour, width } });
      const between = (colour, width) => ({ type: "line", x0: ends[0][0], y0: ends[0][1], x1: ends[1][0], y1: ends[1][1], line: { color: colour, width } });
      const { ground, ink } = data.palette[theme()];
      const outline = (colour, width) => [between(colour, width), around(0, 9, colour, width), around(1, 9, colour, width)];
      Plotly.relayout(map, { shapes: [...lines, ...outline(ground, 6), ...outline(ink, 2.2)] });
    }

    part("thead").append(make("tr"));
    for (const [text, numeric] of [["steps", false], ["verdict", false], ...columns.map(([name]) => [name, true])]) {
      part("thead tr").append(make("th", text, { scope: "col", className: numeric ? "number" : "" }));
    }
    const choices = filters();
    part(".filter").append(...choices.map(([text], k) => make("option", text, { value: String(k) })));
    part(".filter").addEventListener("change", (event) => {
      shown = choices[Number(event.target.value)][1]();
      first = 0;
      showPage();
    });
    part("tbody").addEventListener("click", (event) => {
      const button = event.target.closest("button.closure");
      if (button) select(Number(button.dataset.closure));
    });
    for (const [selector, change] of [[".back", -PAGE], [".forward", PAGE]]) {
      part(selector).addEventListener("click", () => {
        first = Math.max(0, first + change);
        showPage();
      });
    }
    for (const [selector, change] of [[".previous", -1], [".next", 1]]) {
      part(selector).addEventListener("click", () => select(shown[Math.min(shown.length - 1, Math.max(0, shown.indexOf(chosen) + change))]));
    }
    showPage();
    const start = closures.verdicts.indexOf("accepted");
    select(start < 0 ? 0 : start);
    first = 0; // the table opens at its beginning, wherever the closure shown is
    showPage();
    part(".closures .scroll").scrollTop = 0;
    return () => {
      map.on("plotly_click", (event) => {
        const point = event.points.find((each) => each.customdata !== undefined);
        if (point) select(Number(point.customdata));
      });
      marks.set(map, () => mark(chosen));
      mark(chosen);
    };
  }

  /** An array of numbers as plotly keeps it: a list, or bytes that it has decoded beside them. */
  const numbers = (array) => array._inputArray ?? array;

  const ready = new Map(); // article of a run: what its map needs once it is drawn
  for (const article of document.querySelectorAll("article.run")) {
    const run = data.runs[Number(article.dataset.run)];
    if (run.closures.verdicts.length) ready.set(article, startClosures(article, run));
  }
  // The library of the charts comes after this script.
  addEventListener("DOMContentLoaded", () => {
    for (const [name, figure] of Object.entries(data.comparison)) drawWhenSeen(document.querySelector(`#comparison [data-chart="${name}"]`), figure);
    for (const article of document.querySelectorAll("article.run")) {
      const { charts } = data.runs[Number(article.dataset.run)];
      for (const [name, figure] of Object.entries(charts)) drawWhenSeen(article.querySelector(`[data-chart="${name}"]`), figure, name === "map" ? ready.get(article) : undefined);
    }
  });
  retheme();
})();
