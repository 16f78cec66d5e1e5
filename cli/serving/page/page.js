// Drop, look, diagnose: requests to the server of this page, and what is shown when.
import { clock, comparison, h, inspection, progress, result, size, title } from "./views.js";

const KEY = "nsde-token";
const JOB = /^#\d{8}-\d{6}-[0-9a-f]{16}$/;
const AT_WORK = ["looking", "waiting", "running"];
const byId = (id) => document.getElementById(id);
const state = { about: null, job: null, shown: "", timer: 0, asked: 0 };

function token() {
  if (location.hash.length > 1 && !JOB.test(location.hash)) {
    sessionStorage.setItem(KEY, location.hash.slice(1));
    history.replaceState(null, "", "/"); // the key does not stay in the address
  }
  return sessionStorage.getItem(KEY) || "";
}

function say(text) {
  const box = byId("message");
  box.hidden = !text;
  box.textContent = text || "";
  if (text) box.scrollIntoView({ block: "nearest" });
}

async function ask(method, path, body) {
  const headers = { "X-Nsde-Token": token() };
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let answer;
  try {
    answer = await fetch(`/api/jobs${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch {
    throw new Error("The page's server does not answer: was `nsde serve` ended? Start it again; what is kept is listed then.");
  }
  const content = await answer.json().catch(() => ({ error: `The server answered ${answer.status}.` }));
  if (!answer.ok) throw new Error(content.error);
  return content;
}

/** Run something that may be refused, and show the sentence. */
async function attempt(work) {
  say("");
  try { return await work(); } catch (error) { say(error.message); return null; }
}

// ---- sending logs ----

function send(job, index, file, told) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest(); // fetch does not tell how much is sent
    request.open("PUT", `/api/jobs/${job.id}/logs/${index}`);
    request.setRequestHeader("X-Nsde-Token", token());
    request.upload.onprogress = (event) => told(event.loaded);
    request.onload = () => {
      if (request.status < 300) { resolve(); return; }
      let text = `The server answered ${request.status}.`;
      try { text = JSON.parse(request.responseText).error; } catch { /* not its own answer */ }
      reject(new Error(text));
    };
    request.onerror = () => reject(new Error(`${file.name} could not be read or sent.`));
    request.send(file);
  });
}

async function upload(files, leftOut = []) {
  if (!byId("sending").hidden) { say("Logs are being sent; wait until they have arrived."); return; }
  await attempt(async () => {
    const system = byId("system").value || null;
    const job = await ask("POST", "", { system, files: files.map((f) => ({ name: f.name, size: f.size })) });
    const all = files.reduce((sum, f) => sum + f.size, 0);
    byId("sending").hidden = false;
    try {
      let before = 0;
      for (const [k, file] of files.entries()) {
        await send(job, k, file, (sent) => {
          byId("sent").value = (before + sent) / all;
          byId("sending-text").textContent = `${size(before + sent)} of ${size(all)}`;
        });
        before += file.size;
      }
      await ask("POST", `/${job.id}/inspect`, { system });
      await open(job.id);
      if (leftOut.length) say(`Left out, as no logs: ${leftOut.slice(0, 5).join(", ")}${leftOut.length > 5 ? ", ..." : ""}.`);
    } catch (error) {
      await ask("DELETE", `/${job.id}`).catch(() => null); // half an upload is kept by nobody
      throw error;
    } finally {
      byId("sending").hidden = true;
      byId("sent").value = 0;
    }
  });
  await list();
}

/** Four recordings of a mass on a spring with a dry friction of 0.3 m/s2, which the declared physics has not. */
function sample() {
  let seed = 7;
  const noise = () => [...Array(12)].reduce((sum) => sum + (seed = (seed * 48271) % 2147483647) / 2147483647, -6);
  return [0, 1, 2, 3].map((run) => {
    let q = noise(), v = 0, force = 0, rows = "t,q,q_dot,force\n";
    for (let k = 0; k < 1000; k++) {
      if (k % 20 === 0) force = 2 * noise();
      rows += `${k / 100},${(q + 0.001 * noise()).toFixed(5)},${(v + 0.003 * noise()).toFixed(5)},${force.toFixed(5)}\n`;
      for (let i = 0; i < 20; i++) { v += 0.0005 * (force - 4 * q - 0.4 * v - 0.3 * Math.tanh(v / 0.005)); q += 0.0005 * v; }
    }
    return new File([rows], `sample_${run}.csv`);
  });
}

const known = (name) => state.about.suffixes.some((s) => name.toLowerCase().endsWith(s));

/** Files of a folder: the logs alone. */
function fromFolder(files) {
  const seen = files.filter((f) => !f.name.startsWith("."));
  const logs = seen.filter((f) => known(f.name)).sort((a, b) => a.name.localeCompare(b.name));
  if (!logs.length) say("There is no log in this folder.");
  else upload(logs, seen.filter((f) => !known(f.name)).map((f) => f.name));
}

async function entries(folder) {
  const reader = folder.createReader();
  const out = [];
  for (;;) {
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) break;
    out.push(...some);
  }
  const files = out.filter((e) => e.isFile);
  return Promise.all(files.map((e) => new Promise((resolve, reject) => e.file(resolve, reject))));
}

async function dropped(event) {
  const items = [...event.dataTransfer.items].filter((i) => i.kind === "file").map((i) => i.webkitGetAsEntry());
  const files = [...event.dataTransfer.files];
  if (items.length === 1 && items[0]?.isDirectory) fromFolder(await entries(items[0]));
  else if (items.some((i) => i?.isDirectory)) say("Drop one folder, or files, not both.");
  else if (files.length) upload(files);
}

// ---- a job ----

const act = {
  inspect: (job, mapping, system = job.system) => attempt(async () => {
    await ask("POST", `/${job.id}/inspect`, { mapping, system: system || null });
    await open(job.id);
  }),
  diagnose: (job) => attempt(async () => { await ask("POST", `/${job.id}/diagnose`, {}); await open(job.id); }),
  cancel: (job) => attempt(async () => { await ask("POST", `/${job.id}/cancel`, {}); await open(job.id); }),
  remove: (job) => attempt(async () => {
    if (!confirm(`Delete ${title(job)} with its logs and results?`)) return;
    await ask("DELETE", `/${job.id}`);
    if (state.job?.id === job.id) show(null);
    await list();
  }),
  compare: (job) => attempt(async () => {
    const other = await ask("GET", `/${job.id}`);
    byId("comparison")?.remove();
    byId("result").before(comparison(state.job, other));
    byId("comparison").scrollIntoView({ block: "nearest" });
  }),
  copy: async (text, button) => {
    try {
      await navigator.clipboard.writeText(text);
    } catch {
      say("The browser does not let the page copy: mark the command and copy it by hand.");
      return;
    }
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  },
};

function buttons(job) {
  if (["waiting", "running", "looking"].includes(job.state)) return h("button", { type: "button", onclick: () => act.cancel(job) }, "Stop");
  const again = ["failed", "cancelled"].includes(job.state);
  if (job.state !== "ready" && !(again && job.inspection?.usable)) return null;
  return h("button", { type: "button", className: "first", id: "start", onclick: () => act.diagnose(job) }, again ? "Diagnose again" : "Diagnose");
}

function show(job) {
  const box = byId("job");
  clearTimeout(state.timer);
  box.hidden = !job;
  document.body.classList.toggle("opened", Boolean(job));
  const finished = job?.state === "done" && state.job?.id === job.id && state.job.state === "running";
  state.job = job;
  if (!job) { state.shown = ""; document.title = "Diagnose a log"; history.replaceState(null, "", "/"); return; }
  history.replaceState(null, "", `#${job.id}`);
  document.title = `${title(job)}: ${job.called}`;
  const now = `${job.id} ${job.state} ${job.sentence} ${job.mapping} ${job.system}`;
  if (now !== state.shown) { // what a person may be typing in is made anew when something changed alone
    state.shown = now;
    const running = h("div", { id: "progress" });
    const inside = box.contains(document.activeElement);
    box.replaceChildren(
      h("h2", {}, title(job)),
      h("p", { attr: { role: "status" } }, `${job.called[0].toUpperCase()}${job.called.slice(1)}`, job.state === "done" && ` in ${clock(job.seconds)}`, "."),
      buttons(job) ? h("div", { className: "row" }, buttons(job)) : "",
      job.sentence ? h("p", { className: "message", attr: { role: "alert" } }, job.sentence) : "",
      ...[result(job, act)].flat(9).filter(Boolean), running,
      ...inspection(job, act, state.about.systems).flat(9).filter(Boolean),
      h("p", {}, job.printed ? h("a", { href: `/jobs/${job.id}/log.txt`, target: "_blank", rel: "noopener", className: "small" }, "What the commands printed") : ""),
    );
    if (finished) byId("result")?.focus();
    else if (inside) box.querySelector("button")?.focus(); // who uses the keyboard stays in the job
  }
  if (["waiting", "running"].includes(job.state)) byId("progress").replaceChildren(h("h3", {}, "Diagnosis"), ...progress(job, state.about.seconds));
  if (AT_WORK.includes(job.state)) state.timer = setTimeout(() => open(job.id, true), 700);
}

async function open(id, again = false) {
  const asked = ++state.asked;
  try {
    const job = await ask("GET", `/${id}`);
    if (asked !== state.asked) return; // another was opened meanwhile
    const before = state.job?.state;
    show(job);
    if (before !== job.state || !again) await list();
  } catch (error) {
    say(error.message);
    if (again) state.timer = setTimeout(() => open(id, true), 3000);
  }
}

async function list() {
  const about = await ask("GET", "");
  const first = !state.about;
  state.about = about;
  if (first) {
    byId("system").append(...about.systems.map((s) => h("option", { value: s, selected: s === about.system }, s)));
    byId("files").accept = about.suffixes.join(",");
    byId("accepted").textContent = `${about.suffixes.join(" ")}; up to ${size(about.upload)} together.`;
    byId("where").textContent = `Kept in ${about.folder}.`;
  }
  byId("kept").replaceChildren(...about.jobs.map((job) => h("li", job.id === state.job?.id ? { attr: { "aria-current": "true" } } : {},
    h("button", { type: "button", className: "name", onclick: () => { say(""); open(job.id); } }, title(job)),
    h("div", { className: "small" }, h("span", {}, [job.machine, job.created.slice(0, 16).replace("T", " "), job.called].filter(Boolean).join(" · ")),
      state.job?.state === "done" && job.state === "done" && job.id !== state.job.id &&
        h("button", { type: "button", className: "quiet", attr: { "aria-label": `Compare with ${title(job)}` }, onclick: () => act.compare(job) }, "Compare"),
      AT_WORK.includes(job.state) ? "" : h("button", { type: "button", className: "quiet", attr: { "aria-label": `Delete ${title(job)}` }, onclick: () => act.remove(job) }, "Delete")))));
  if (!about.jobs.length) byId("kept").replaceChildren(h("li", { className: "small" }, "None yet."));
}

const zone = byId("drop");
for (const name of ["dragover", "dragleave", "drop"]) {
  // beside the zone, too: else the browser would leave the page and show the file
  document.addEventListener(name, (event) => { event.preventDefault(); zone.classList.toggle("over", name === "dragover"); });
}
document.addEventListener("drop", dropped);
byId("files").addEventListener("change", (event) => { upload([...event.target.files]).finally(() => { event.target.value = ""; }); });
byId("folder").addEventListener("change", (event) => { fromFolder([...event.target.files]); event.target.value = ""; });
byId("sample").addEventListener("click", () => { byId("system").value = "mass_spring_damper"; upload(sample()); });
const wanted = JOB.test(location.hash) ? location.hash.slice(1) : null;
token();
attempt(list).then(() => { if (state.about && wanted) open(wanted); });
