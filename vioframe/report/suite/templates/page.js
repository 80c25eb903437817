"use strict";
// Plots, filters and tables of the page. A trace's `meta` says whose it is: `series` is its entry in the legend,
// `detector` and `backend` what the filters know it by; `owners` says so for each of its points instead, and `x_back` how
// many traces before it the one is that has its x.
(() => {
  const plots = JSON.parse(document.getElementById("plots").textContent);
  const DARK = JSON.parse(document.getElementById("colours").textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const VIEWS = {
    perspective: { eye: { x: -1.26, y: -1.53, z: 0.94 }, center: { x: 0, y: 0, z: -0.17 }, up: { x: 0, y: 0, z: 1 }, projection: { type: "perspective" } },
    top: { eye: { x: 0, y: 0, z: 1.9 }, up: { x: 0, y: 1, z: 0 }, projection: { type: "orthographic" } },
    side: { eye: { x: 0, y: -1.3, z: 0 }, up: { x: 0, y: 0, z: 1 }, projection: { type: "orthographic" } },
  };
  const CONFIG = { responsive: true, displaylogo: false, scrollZoom: false, plotlyServerURL: "" };
  // From so many times as far away, as a narrow picture needs.
  const seenFrom = (view, times) => {
    const { eye, ...camera } = VIEWS[view];
    return { ...camera, eye: { x: times * eye.x, y: times * eye.y, z: times * eye.z } };
  };
  // Named one by one: Plotly would add one that sends the plot to its maker.
  const BUTTONS = [["toImage"], ["zoom2d", "pan2d", "resetScale2d"]];
  const BUTTONS_3D = [["toImage"], ["zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]];
  let printing = false;
  const each = (selector, use, root = document) => root.querySelectorAll(selector).forEach(use);
  const isDark = () => dark.matches && !printing;
  // What follows the six digits is the opacity.
  const shade = (colour) => {
    const darker = isDark() && typeof colour === "string" && DARK[colour.slice(0, 7).toLowerCase()];
    return darker ? darker + colour.slice(7) : colour;
  };
  const token = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // Filters ------------------------------------------------------------------------------------------------------
  const unchecked = { detector: new Set(), backend: new Set() };
  const passes = (owner) => !unchecked.detector.has(owner.detector) && !unchecked.backend.has(owner.backend);

  function applyFilters() {
    each("[data-detector], [data-backend]", (element) => {
      if (!element.closest(".filters")) element.hidden = !passes(element.dataset);
    });
    each("figure.plot", (figure) => figure.dispatchEvent(new Event("redraw")));
  }

  each(".filters input", (box) => {
    box.checked = true;
    box.addEventListener("change", () => {
      unchecked[box.name][box.checked ? "delete" : "add"](box.value);
      applyFilters();
    });
  });

  // Plots --------------------------------------------------------------------------------------------------------
  function theme() {
    const [ink, muted, grid, page, rule] = ["--ink", "--muted", "--grid", "--page", "--rule"].map(token);
    const axis = {
      gridcolor: grid, zerolinecolor: rule, zerolinewidth: 1, linecolor: muted, tickcolor: grid, ticks: "outside", ticklen: 4,
      automargin: true, title: { font: { size: 13, color: muted }, standoff: 10 }, tickfont: { size: 12, color: muted },
    };
    const axis3d = { ...axis, showbackground: false, showspikes: false, automargin: undefined, ticks: "", tickangle: 0 };
    return {
      layout: {
        font: { family: token("--text"), size: 13, color: ink }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
        margin: { l: 8, r: 12, t: 26, b: 8 }, showlegend: false, hovermode: "closest", xaxis: axis, yaxis: axis,
        scene: { xaxis: axis3d, yaxis: axis3d, zaxis: axis3d },
        hoverlabel: { bgcolor: page, bordercolor: muted, font: { family: token("--text"), size: 13, color: ink }, align: "left", namelength: -1 },
        modebar: { bgcolor: "rgba(0,0,0,0)", color: muted, activecolor: ink },
        annotationdefaults: { font: { size: 13, color: ink }, showarrow: false },
      },
    };
  }

  function shaded(value) {
    if (typeof value === "string") return shade(value);
    if (Array.isArray(value)) return value.map(shaded);
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, part]) => [key, /colou?r|^line$|^marker$|^error_[xy]$/.test(key) ? shaded(part) : part]));
  }

  // Points of owners that a filter hides are taken out, so that their category leaves the axis too.
  function onlyPassing(trace) {
    const owners = trace.meta.owners;
    if (!owners) return trace;
    const keep = owners.map(passes);
    const pick = (list) => (Array.isArray(list) && list.length === keep.length ? list.filter((_, i) => keep[i]) : list);
    const kept = { ...trace };
    for (const key of ["x", "y", "text", "customdata"]) kept[key] = Array.isArray(trace[key]?.[0]) ? trace[key].map(pick) : pick(trace[key]);
    for (const key of ["error_x", "error_y"]) {
      if (trace[key]) kept[key] = { ...trace[key], array: pick(trace[key].array), arrayminus: pick(trace[key].arrayminus) };
    }
    return kept;
  }

  function swatch(trace) {
    const line = trace.line || {}, colour = shade(line.color || trace.marker?.color || trace.fillcolor);
    const solid = trace.type === "bar" || trace.type === "box" || (trace.fill && trace.fill !== "none");
    const dash = { dash: "5 3", dot: "2 3", dashdot: "6 2 2 2" }[line.dash] || "none";
    const faint = trace.opacity ?? 1;
    const mark = !solid && trace.mode === "markers";
    const hollow = String(trace.marker?.symbol).endsWith("-open");
    const shape = mark
      ? `<path d="${hollow ? "M12 1L17 6L12 11L7 6Z" : "M7 6a5 5 0 1 0 10 0a5 5 0 1 0 -10 0Z"}" fill="${hollow ? "none" : colour}" stroke="${colour}" stroke-width="${hollow ? 2 : 0}"/>`
      : solid
      ? `<rect x="5" y="1" width="13" height="10" rx="2" fill="${shade(trace.fillcolor || colour)}" fill-opacity="${faint}" stroke="${colour}" stroke-opacity="${Math.max(faint, 0.4)}"/>`
      : `<line x1="0" x2="24" y1="6" y2="6" stroke="${colour}" stroke-width="${Math.min(line.width || 2.4, 6)}" stroke-opacity="${faint}" stroke-dasharray="${dash}"/>`;
    return `<svg width="24" height="12" aria-hidden="true">${shape}</svg>`;
  }

  function setUp(figure) {
    const plot = plots[figure.dataset.plot];
    const canvases = figure.querySelector(".canvases"), legend = figure.querySelector(".legend"), select = figure.querySelector("select.case");
    const hidden = new Set();
    let view = "perspective", drawn = false;
    const current = () => plot.cases[select ? select.selectedIndex : 0];
    canvases.style.minHeight = `${plot.height}px`;

    function drawLegend() {
      const first = new Map();
      for (const trace of current().pictures.flatMap((picture) => picture.data)) {
        const { series, owners } = trace.meta;
        // A line says more of its series than the area about it.
        const better = !first.has(series) || (first.get(series).fill && !trace.fill);
        if (series && better && (owners ? owners.some(passes) : passes(trace.meta))) first.set(series, trace);
      }
      const focused = legend.contains(document.activeElement) && document.activeElement.dataset.series;
      legend.replaceChildren();
      for (const [series, trace] of first) {
        const button = document.createElement("button");
        button.type = "button";
        button.dataset.series = series;
        button.setAttribute("aria-pressed", String(!hidden.has(series)));
        button.innerHTML = swatch(trace);
        button.append(series);
        button.addEventListener("click", () => {
          hidden[hidden.has(series) ? "delete" : "add"](series);
          draw();
        });
        legend.append(button);
        if (focused === series) button.focus();
      }
    }

    function drawPicture({ data, layout }, canvas) {
      const traces = data.map((trace, i) => ({ ...shaded(onlyPassing(trace)), x: onlyPassing(data[i - (trace.meta.x_back || 0)]).x, visible: passes(trace.meta) && !hidden.has(trace.meta.series) }));
      const shown = { ...layout, template: theme(), autosize: true };
      if (shown.shapes) shown.shapes = shown.shapes.map(shaded);
      const narrow = canvas.clientWidth < 560;
      const hiddenAxis = { top: "zaxis", side: "yaxis" }[view];
      if (hiddenAxis) shown.scene = { ...shown.scene, [hiddenAxis]: { visible: false } };
      if (plot.views) shown.scene = { ...shown.scene, camera: seenFrom(view, narrow ? 1.9 : 1), uirevision: `${select?.selectedIndex} ${view}`, dragmode: view === "perspective" ? "turntable" : "pan" };
      canvas.style.height = `${(narrow && plot.narrow_height) || plot.height}px`;
      return Plotly.react(canvas, traces, shown, { ...CONFIG, modeBarButtons: plot.views ? BUTTONS_3D : BUTTONS, displayModeBar: !narrow && !printing });
    }

    function draw() {
      drawn = true;
      const { pictures, caption } = current();
      while (canvases.children.length > pictures.length) {
        Plotly.purge(canvases.lastChild);
        canvases.lastChild.remove();
      }
      while (canvases.children.length < pictures.length) canvases.append(Object.assign(document.createElement("div"), { className: "canvas" }));
      figure.querySelector(".case-caption").textContent = caption ? caption + " " : "";
      drawLegend();
      pictures.forEach((picture, k) => drawPicture(picture, canvases.children[k]));
      canvases.style.minHeight = "";
    }

    each("[data-view]", (button) => button.addEventListener("click", () => {
      view = button.dataset.view;
      each("[data-view]", (other) => other.setAttribute("aria-pressed", String(other === button)), figure);
      draw();
    }), figure);
    // One flight is chosen for the whole page: plots of the same flight are read together.
    select?.addEventListener("change", () => {
      each("select.case", (other) => {
        const same = [...other.options].findIndex((option) => option.text === select.value);
        if (other !== select && same >= 0) {
          other.selectedIndex = same;
          other.closest("figure").dispatchEvent(new Event("redraw"));
        }
      });
      draw();
    });
    figure.addEventListener("redraw", () => drawn && draw());
    figure.addEventListener("show", () => drawn || draw());
  }

  const nearby = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      nearby.unobserve(target);
      target.dispatchEvent(new Event("show"));
    }
  }, { rootMargin: "800px" });
  each("figure.plot", (figure) => {
    setUp(figure);
    nearby.observe(figure);
  });

  function recolour() {
    each("[data-colour]", (element) => element.style.setProperty("--colour", shade(element.dataset.colour)));
    each("figure.plot", (figure) => figure.dispatchEvent(new Event("redraw")));
  }
  recolour();
  dark.addEventListener("change", recolour);
  const onPrint = (now) => () => {
    printing = now;
    document.documentElement.classList.toggle("light", now);
    each("figure.plot", (figure) => figure.dispatchEvent(new Event("show")));
    recolour();
  };
  addEventListener("beforeprint", onPrint(true));
  addEventListener("afterprint", onPrint(false));

  // Tables -------------------------------------------------------------------------------------------------------
  const text = new Intl.Collator("en", { numeric: true });
  function compare(a, b) {
    const [x, y] = [a.dataset.sort ?? "", b.dataset.sort ?? ""];
    if (x !== "" && y !== "") return x - y;
    return a.textContent.trim() === b.textContent.trim() ? 0 : text.compare(a.textContent.trim(), b.textContent.trim());
  }

  function sortBy(table, header) {
    const column = header.cellIndex, downwards = header.getAttribute("aria-sort") === "ascending";
    const numeric = header.classList.contains("number");
    const body = table.tBodies[0];
    const missing = (row) => numeric && row.cells[column].dataset.sort === undefined;
    const rows = [...body.rows].sort((a, b) => {
      // What is missing stays at the end, whichever way round.
      if (missing(a) || missing(b)) return missing(a) - missing(b);
      return (downwards ? -1 : 1) * compare(a.cells[column], b.cells[column]);
    });
    body.append(...rows);
    each("th[aria-sort]", (other) => other.setAttribute("aria-sort", "none"), table);
    header.setAttribute("aria-sort", downwards ? "descending" : "ascending");
  }
  each("table", (table) => each("th[aria-sort]", (header) => {
    header.querySelector("button").addEventListener("click", () => sortBy(table, header));
  }, table));

  // The rest -----------------------------------------------------------------------------------------------------
  each(".copy", (button) => button.addEventListener("click", async () => {
    const code = button.parentElement.querySelector("code");
    try {
      await navigator.clipboard.writeText(code.textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(code);
      button.textContent = "Selected";
    }
  }));
  const links = new Map([...document.querySelectorAll(".side a")].map((link) => [link.hash.slice(1), link]));
  const reading = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      links.forEach((link, id) => (id === target.id ? link.setAttribute("aria-current", "true") : link.removeAttribute("aria-current")));
    }
  }, { rootMargin: "-20% 0px -70% 0px" });
  each("main section", (section) => reading.observe(section));
})();
