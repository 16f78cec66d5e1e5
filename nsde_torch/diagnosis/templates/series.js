// The log over time: one run at a time, all charts with one cursor and one zoom, and the path of a flight in space.
(() => {
  const log = JSON.parse(document.getElementById("series").textContent);
  const box = document.getElementById("charts"), pick = document.getElementById("run");
  const colours = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"], HIGH = 125, ABOVE = 36, BELOW = 44; // px
  const values = ([low, size, packed]) => {
    const bytes = Uint8Array.from(atob(packed), (c) => c.charCodeAt(0));
    return Array.from(new Int16Array(bytes.buffer), (v) => (v === -32768 ? null : low + (v + 32767) * size));
  };
  const band = (t, low, high) => { // one polygon for each stretch
    const x = [], y = [];
    for (let from = 0, to; from < t.length; from = to + 1) {
      to = low.indexOf(null, from); if (to < 0) to = t.length;
      const part = t.slice(from, to);
      x.push(...part, ...[...part].reverse(), null); y.push(...low.slice(from, to), ...high.slice(from, to).reverse(), null);
    }
    return { x, y };
  };
  const plain = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;");
  const known = (unit) => (unit && unit !== "1" ? plain(unit) : "");
  const font = { family: "system-ui, sans-serif", size: 12, color: "#555" };
  const config = { responsive: true, displayModeBar: false, scrollZoom: false, doubleClick: "reset" };
  const lines = { color: "#1a1a1a", gridcolor: "#e5e5e5", zeroline: false, tickcolor: "#e5e5e5", tickfont: font };
  const area = (label) => {
    const made = document.createElement("div");
    made.setAttribute("role", "img"); made.setAttribute("aria-label", label);
    box.append(made);
    return made;
  };
  const charts = area("charts of the log over time");
  if (log.path.length) box.append(Object.assign(document.createElement("h3"), { textContent: "path in space (drag to turn it)" }));
  const space = log.path.length ? area("path in space") : null;

  function draw(run) {
    const shown = log.charts.filter(({ of }) => run[of].t), whole = shown.length * (ABOVE + HIGH), data = [], titles = [];
    const layout = {
      height: whole + BELOW, margin: { t: 0, r: 8, b: BELOW, l: 64 }, font, showlegend: false, annotations: titles,
      paper_bgcolor: "#fff", plot_bgcolor: "#fff", hoverlabel: { font: { ...font, color: "#1a1a1a" }, bordercolor: "#ddd" },
      hovermode: "x unified", dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom", // a finger scrolls
      xaxis: { ...lines, anchor: `y${shown.length}`, title: { text: "t [s]", font, standoff: 6 }, unifiedhovertitle: { text: "%{x:.6~g} s" },
        showspikes: true, spikemode: "across", spikesnap: "cursor", spikethickness: 1, spikedash: "solid", spikecolor: "#999" },
    };
    shown.forEach(({ of, names, unit }, k) => {
      const top = 1 - (k * (ABOVE + HIGH) + ABOVE) / whole, own = run[of], yaxis = `y${k + 1}`;
      layout[`yaxis${k + 1}`] = { ...lines, domain: [Math.max(top - HIGH / whole, 0), top], fixedrange: true, nticks: 5, tickformat: ".4~g" };
      const shownNames = of === "ahead" ? names.slice(0, -2) : names, palette = { log: colours, left: ["#999", "#D55E00"], ahead: ["#1a1a1a", "#0072B2", "#D55E00"] }[of];
      const last = palette[shownNames.length - 1]; // the ends of the band of predictions are its last two names
      if (of === "ahead") data.push({ type: "scatter", mode: "lines", ...band(own.t, ...names.slice(-2).map((name) => values(own.y[name]))), yaxis,
        line: { width: 0, color: last }, hoverinfo: "skip", fill: "toself", fillcolor: `${last}30` });
      const coloured = shownNames.map((name, n) => {
        const color = palette[n % palette.length];
        data.push({ type: "scatter", mode: "lines", x: own.t, y: values(own.y[name]), name: plain(name), line: { color, width: 1 },
          yaxis, hovertemplate: `%{y:.4~g} ${known(unit)}` });
        return `<span style="color:${color}">${plain(of === "log" ? name : name.slice(name.lastIndexOf(" ") + 1))}</span>`;
      }).join(", ");
      const channel = plain(names[0].replace(/ \w+$/, "")), words = { log: "", left: `what the physics leaves of ${channel}, `, ahead: `predictions of ${channel}, ` };
      const text = words[of] + coloured + (known(unit) && ` [${known(unit)}]`);
      titles.push({ text: `<b>${text}</b>`, x: 0, y: top, xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom", showarrow: false, font: { ...font, size: 13, color: "#1a1a1a" } });
    });
    layout.hoversubplots = data.length > 12 ? "overlaying" : "axis"; // the values of all charts, where they are few
    Plotly.react(charts, data, layout, config);
    if (!space) return;
    const [x, y, z] = log.path.map((name) => values(run.log.y[name]));
    const axes = log.path.map((name) => ({ ...lines, title: { text: `${plain(name)} [m]`, font }, showspikes: false }));
    Plotly.react(space, [{ type: "scatter3d", mode: "lines", x, y, z, line: { color: colours[0], width: 2 }, hovertemplate: "%{x:.4~g}, %{y:.4~g}, %{z:.4~g} m<extra></extra>" }], {
      height: 460, margin: { t: 0, r: 0, b: 0, l: 0 }, font, showlegend: false, paper_bgcolor: "#fff",
      scene: { aspectmode: "data", dragmode: "orbit", camera: { eye: { x: 1.6, y: 1.6, z: 1 }, center: { x: 0, y: 0, z: -0.15 } }, xaxis: axes[0], yaxis: axes[1], zaxis: axes[2] },
    }, config);
  }
  pick.append(...log.runs.map((run, k) => Object.assign(document.createElement("option"), { value: k, textContent: run.name })));
  pick.onchange = () => draw(log.runs[pick.value]);
  draw(log.runs[0]);
})();
