// What a job looks like. Whatever came with a log is set as text, never as HTML.

/** An element with properties, attributes (in `attr`) and children. */
export function h(tag, props = {}, ...children) {
  const { attr = {}, ...rest } = props;
  const node = Object.assign(document.createElement(tag), rest);
  for (const [name, value] of Object.entries(attr)) node.setAttribute(name, value);
  node.append(...children.flat().filter((c) => c !== null && c !== undefined && c !== false && c !== ""));
  return node;
}

export function table(head, rows, label) {
  const line = (cells, kind) => h("tr", {}, cells.map((c) => h(kind, kind === "th" ? { attr: { scope: "col" } } : {}, c)));
  const body = h("tbody", {}, rows.map((r) => line(r, "td")));
  return h("div", { className: "wide", tabIndex: 0, attr: { role: "region", "aria-label": label } },
    h("table", {}, h("thead", {}, line(head, "th")), body));
}

export const size = (bytes) => (bytes >= 2 ** 20 ? `${(bytes / 2 ** 20).toPrecision(3)} MiB` : `${Math.ceil(bytes / 1024)} KiB`);
export const clock = (seconds) => {
  const s = Math.round(seconds);
  const rest = s % 60 ? ` ${s % 60} s` : "";
  return s < 60 ? `${s} s` : `${Math.floor(s / 60)} min${rest}`;
};
export const title = (job) => {
  const names = job.files.map((f) => f.given);
  return names.length > 3 ? `${names.slice(0, 2).join(", ")} and ${names.length - 2} more` : names.join(", ");
};
const number = (value) => (value === null ? "-" : Number(value.toPrecision(4)).toString());
const fold = (name, open, ...children) => h("details", { open }, h("summary", {}, name), ...children);
const MARKS = [[true, "ok", "ok"], [false, "no", "no"], [null, "open", "unsure"]];

function columns(found) {
  const rows = found.columns.map((c) => [c.stream ? `${c.stream}/${c.column}` : c.column, c.unit || "-",
    c.rate === null ? "no clock" : number(c.rate), String(c.rows), number(c.low), number(c.high),
    c.missing ? `${(100 * c.missing).toFixed(1)}%` : "-", c.gaps ? String(c.gaps) : "-"]);
  const more = found.all_columns - rows.length;
  return fold(`${found.all_columns} columns of ${found.runs[0]}`, found.usable === false,
    table(["column", "unit", "rate [Hz]", "rows", "lowest", "highest", "missing", "gaps"], rows, "columns"),
    more > 0 && h("p", { className: "small" }, `(${more} more)`));
}

function mapping(job, found, act) {
  if (found.native || !job.mapping) return null;
  const text = h("textarea", { id: "mapping", value: job.mapping, spellcheck: false });
  return fold("What the columns mean: the mapping, which you may correct", found.usable === false,
    h("label", { htmlFor: "mapping", className: "small" }, "Column or topic, unit, axes, order, sign and numbering, as `nsde inspect` writes them."),
    text,
    job.state !== "done" && h("div", { className: "row" },
      h("button", { type: "button", onclick: () => act.inspect(job, text.value) }, "Check this mapping"),
      h("button", { type: "button", className: "quiet", onclick: () => act.inspect(job, null) }, "Propose one anew")));
}

function choose(job, act, systems) {
  if (!["ready", "refused"].includes(job.state)) return null;
  const now = h("select", { id: "other" }, h("option", { value: "" }, "chosen from what is logged"),
    systems.map((s) => h("option", { value: s, selected: s === job.system }, s)));
  return h("div", { className: "row" }, h("label", { htmlFor: "other" }, "Machine"), now,
    h("button", { type: "button", onclick: () => act.inspect(job, null, now.value) }, "Look again"));
}

/** What is in the logs, and whether it can be. */
export function inspection(job, act, systems) {
  const found = job.inspection;
  const out = [h("h3", {}, "What is in it")];
  if (job.state === "looking") return [...out, h("p", {}, "Reading the logs and checking what they mean (some seconds)."), h("progress", { attr: { "aria-label": "reading the logs" } })];
  if (!found) return [...out, choose(job, act, systems)];
  const runs = found.runs.length;
  out.push(h("ul", { className: "facts" }, [`${runs} run${runs > 1 ? "s" : ""}`, `read as ${found.kind}`, `machine: ${job.machine || found.system}`,
    found.native ? "columns of the machine itself: no mapping needed" : ""].filter(Boolean).map((f) => h("li", {}, f))));
  out.push(h("ul", { className: "checks" }, found.checks.map((c) => {
    const [, kind, word] = MARKS.find(([passed]) => passed === c.passed);
    return h("li", {}, h("span", { className: `mark ${kind}` }, word), `${c.name}: ${c.text}`);
  })));
  const list = (name, items) => items.length && [h("p", {}, name), h("ul", {}, items.map((i) => h("li", {}, i)))];
  out.push(list("Missing:", found.missing) || "", list("Logged more than once, look at it:", found.open) || "", list("Assumed:", found.notes) || "");
  out.push(columns(found), mapping(job, found, act), choose(job, act, systems));
  return out;
}

/** Stages of a diagnosis at work. */
export function progress(job, seconds) {
  const last = job.stages.at(-1);
  const rows = job.stages.map((s, k) => {
    const end = k + 1 < job.stages.length ? job.stages[k + 1].began : job.seconds;
    const count = s === last && s.total > 1 ? ` (${Math.min(s.done + 1, s.total)} of ${s.total})` : "";
    return h("li", { className: s === last ? "now" : "" }, h("span", {}, `${s.stage}${count}`), h("span", {}, clock(Math.max(end - s.began, 0))));
  });
  const share = last && last.total > 1 ? { max: last.total, value: last.done } : {};
  const text = job.state === "waiting" ? "Waits for the diagnosis before it." : `${last ? last.stage : "starting"}, ${clock(job.seconds)} since it began. Three minutes of flight take about two minutes.`;
  return [h("p", {}, text), last && last.found ? h("p", {}, `Found so far: ${last.found}.`) : "", h("progress", { ...share, attr: { "aria-label": "this stage" } }),
    h("ol", { className: "stages" }, rows), h("p", { className: "small" }, `It is stopped after ${clock(seconds)}.`)];
}

function finding(one, job, act) {
  const rows = one.parameters.map((p) => [p.name, `${p.value} ${p.unit}`.trim(), p.interval]);
  return h("section", { className: "finding" },
    h("h4", {}, h("code", {}, one.name), one.recording && " (the recording)", " ", one.lead && h("span", { className: "lead" }, `provisional: ${one.lead}`)),
    h("p", {}, one.sentence), one.law && h("p", {}, h("code", {}, one.law)), one.worth && h("p", {}, one.worth),
    rows.length > 0 && table(["parameter", "value", "90 % interval"], rows, `parameters of ${one.name}`),
    one.p && h("p", { className: "small" }, `Chance of this if it were not there: p ${one.p}.`),
    one.ties.map((t) => h("p", {}, h("b", {}, "Indistinguishable. "), `These data do not distinguish it from ${t.effects.join(", ")}.`, t.experiment && ` To distinguish them: ${t.experiment}.`)),
    one.picture && picture(job, one.picture, `Residual with everything that was found, and with ${one.name} added back. What it explains is the difference; a good model lies on zero.`));
}

function picture(job, name, caption) {
  const src = `/jobs/${job.id}/${encodeURIComponent(name)}`;
  return h("figure", {}, h("a", { href: src, target: "_blank", rel: "noopener" }, h("img", { src, alt: caption, loading: "lazy" })), h("figcaption", {}, caption));
}

const CAPTIONS = {
  "held_out.png": (s) => `Fitted to the other runs and measured on ${s.measured_on}: the residual after over before, and the gain in log-likelihood.`,
  "residual.png": () => "Measured rate less that of the physics, before and after. A good model lies on zero.",
  "unexplained.png": () => "What is left after everything that was found.",
  "flexible.png": () => "What functions of what was measured still add; grey where no data are near.",
};

/** Verdict, effects, before and after, pictures, files, and the command that repeats it. */
export function result(job, act) {
  const s = job.summary;
  if (!s) return [];
  const link = (file, text) => h("a", { className: "button", href: `/jobs/${job.id}/${file}?save`, attr: { download: file } }, text);
  const own = (list) => list.map((f) => finding(f, job, act));
  return [
    h("h3", { id: "result", tabIndex: -1 }, "Result"),
    h("div", { className: `verdict ${s.verdict}` }, h("b", {}, s.heading), s.summary),
    s.warnings.map((w) => h("p", { className: "message" }, w)),
    h("div", { className: "row" }, link("report.html", "report.html"), link("effects.yaml", "effects.yaml"), link("diagnosis.json", "diagnosis.json")),
    own(s.findings), s.aside.map((a) => h("p", {}, a)),
    s.unexplained.length > 0 && [h("h3", {}, "What no effect of the catalogue explains"), h("ul", {}, s.unexplained.map((u) => h("li", {}, u)))],
    s.residual.length > 0 && [h("h3", {}, `Before and after, on ${s.measured_on}`),
      table(["residual of the rate of", "before", "after", "ratio", "unit"], s.residual.map((r) => [r.name, r.before, r.after, `×${r.ratio}`, r.unit]), "residual before and after")],
    s.predictions.length > 0 && s.horizons.length > 0 && fold(`Errors of open-loop predictions on ${s.measured_on}${s.changed ? ", before → after" : ""}`, false,
      table(["rms error", ...s.horizons.map((t) => `${t} s`)], s.predictions.map((p) => [`${p.name} [${p.unit}]`, ...p.cells.map(([b, a]) => (s.changed ? `${b} → ${a}` : b))]), "errors of predictions")),
    s.pictures.map((name) => picture(job, name, CAPTIONS[name](s))),
    h("h3", {}, "The command that repeats it"), command(job, act),
    fold("The whole report", false, h("p", {}, h("a", { href: `/jobs/${job.id}/report.html`, target: "_blank", rel: "noopener" }, "Open it in a tab of its own")),
      h("iframe", { src: `/jobs/${job.id}/report.html`, title: "report", loading: "lazy", attr: { sandbox: "allow-scripts" } })),
  ];
}

/** Two diagnoses beside one another: verdicts, values with intervals, residuals. */
export function comparison(one, other) {
  const rows = (job) => new Map([["verdict", job.summary.heading],
    ...job.summary.findings.flatMap((f) => (f.parameters.length ? f.parameters : [null]).map((p) =>
      (p ? [`${f.name}: ${p.name}`, `${p.value} ${p.unit} (${p.interval})`] : [f.name, "found"]))),
    ...job.summary.residual.map((r) => [`residual of ${r.name}, before and after`, `${r.before}, ${r.after} ${r.unit}`])]);
  const [left, right] = [rows(one), rows(other)];
  const names = [...new Set([...left.keys(), ...right.keys()])];
  return h("section", { id: "comparison" }, h("h3", {}, "Beside one another"),
    table(["", ...[one, other].map((job) => `${title(job)}, ${job.created.slice(0, 16).replace("T", " ")}`)],
      names.map((name) => [name, left.get(name) ?? "-", right.get(name) ?? "-"]), "two diagnoses"));
}

export function command(job, act) {
  const copy = h("button", { type: "button", className: "quiet", onclick: () => act.copy(job.repeat, copy) }, "Copy");
  return h("div", { className: "command" }, h("code", {}, job.repeat), copy);
}
