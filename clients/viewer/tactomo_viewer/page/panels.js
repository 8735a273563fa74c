// The panels beside the map: what the newest frame, status and events say, as text.

import { contactColour } from "./colormap.js";
import { UNITS, fixed, forceOf, pressureOf, quantityText, seconds } from "./values.js";

const EVENTS_SHOWN = 50;
const TROUBLE_SHOWN_S = 3600;
const SOURCES = { twin: "simulated skin", device: "device", replay: "replay" };
const STATES = { waiting_for_port: "no port yet", waiting_for_data: "no data yet", taring: "taring", running: "running", late: "late", ended: "replay ended", paused: "replay paused", stale: "stale" };
const LINEAR = ["tikhonov", "noser"];  // one step, which runs contacts together

export const byId = (id) => document.getElementById(id);

export function showContacts(contacts, unit) {
  byId("value-head").textContent = unit === "kpa" ? "kPa" : "Δσ/σ₀ %";
  byId("count").textContent = contacts.length || "";
  byId("no-contacts").hidden = contacts.length > 0;
  const body = byId("contacts").tBodies[0];
  fit(body, contacts.length, () => {
    const row = document.createElement("tr");
    for (let i = 0; i < 6; i++) row.append(document.createElement(i ? "td" : "th"));
    row.cells[0].scope = "row";
    row.cells[0].append(element("button"));
    row.cells[0].firstChild.type = "button";
    return row;
  });
  contacts.forEach((contact, i) => {
    const row = body.rows[i];
    Object.assign(row.dataset, { id: contact.id, xMm: contact.x_mm, yMm: contact.y_mm });
    const id = row.cells[0].firstChild;
    setText(id, String(contact.id));
    Object.assign(id, { ariaLabel: `Contact ${contact.id}`, title: "Mark on the map" });
    id.style.background = contactColour(contact.id);
    const touched = contact.pressure_range === "below" ? "touched" : "–";
    const texts = [
      fixed(contact.x_mm, 1), fixed(contact.y_mm, 1), fixed(contact.area_mm2, 0),
      quantityText(pressureOf(contact, unit), UNITS[unit][1]) || touched,
      quantityText(forceOf(contact), 0) || "–",
    ];
    texts.forEach((text, column) => setText(row.cells[column + 1], text));
  });
}

/** A button for each press that is held, by which `lift(press)` takes it away. */
export function showHeld(presses, lift) {
  const key = presses.map(({ id }) => id).join();
  if (byId("held").dataset.presses === key) return;  // a button under a finger must stay
  byId("held").dataset.presses = key;
  byId("held").replaceChildren(...presses.map((press) => {
    const button = element("button", `× ${fixed(press.x, 0)}, ${fixed(press.y, 0)} mm`);
    button.type = "button";
    button.ariaLabel = `Lift the press at x ${fixed(press.x, 0)}, y ${fixed(press.y, 0)} mm`;
    button.onclick = () => lift(press);
    const item = element("li");
    item.append(button);
    return item;
  }));
}

export function showState(name, text = STATES[name] ?? String(name)) {
  byId("state").dataset.state = name;
  setText(byId("state"), text);
}

/** The newest frame's quality; flags of a frame that is out of date say nothing about now. */
export function showQuality(frame, trusted) {
  const { misfit, confidence } = trusted ? frame : { misfit: null, confidence: null };
  setText(byId("misfit"), misfit === null ? "–" : `${fixed(misfit, 1)} σ`);
  setText(byId("confidence"), confidence === null ? "–" : `${fixed(100 * confidence, 0)} %`);
  setText(byId("made-by"), (trusted && frame.tier) || "–");
  setText(byId("made-by-reason"), (trusted && frame.tier_reason) || "");
  const list = byId("quality");
  const isLinear = LINEAR.includes(frame.tier);
  const key = trusted ? `${isLinear} ${frame.flags}` : "not known";
  if (list.dataset.flags === key) return;
  list.dataset.flags = key;
  const chips = !trusted ? [chip("not known", "The newest frame is out of date.", "warn")]
    : frame.flags.length ? frame.flags.map((flag) => chip(flag.replaceAll("_", " "), "", "warn"))
    : isLinear ? [chip("linear: coarse", "One linear step: contacts near each other merge, weak contacts are missed.", "warn")]
    : [chip("good", "No flags.", "good")];
  list.replaceChildren(...chips);
}

function chip(text, title, kind) {
  const item = element("li", text);
  item.className = `chip ${kind}`;
  item.title = title;
  return item;
}

/** What the newest status says; of one that is out of date, `isCurrent` is false. */
export function showStatus(status, isCurrent) {
  const { description, source } = status;
  setText(byId("model"), description?.model ?? "");
  byId("source").hidden = !SOURCES[source?.kind];
  setText(byId("source"), SOURCES[source?.kind] ?? "");
  showStages(status.stage_ms ?? {});
  showChannels(status, isCurrent);
  const { reference, recording } = status;
  setText(byId("reference"), reference
    ? `Reference of ${reference.scans} scans, taken ${clock(reference.taken_realtime_ns)}.`
    : "No reference yet.");
  const record = byId("record");
  record.classList.toggle("on", Boolean(recording));
  record.ariaLabel = recording ? "Stop the recording" : "Record";
  setText(record, recording ? `Stop · ${bytes(recording.bytes)}` : "Record");
  record.title = recording ? recording.path : "Record the bytes of the ports to a file";
  showMethods(status);
}

// The daemon says which methods it has, a user's own ones among them.
function showMethods({ methods = [], tier_requested: requested }) {
  const choice = byId("method");
  const names = methods.includes(requested) || !requested ? methods : [requested, ...methods];
  if (names.join() !== [...choice.options].map(({ value }) => value).join()) {
    choice.replaceChildren(...names.map((name) => element("option", name)));
  }
  if (!requested) return;
  // What is being chosen stays, unless another method was put in force meanwhile.
  if (document.activeElement !== choice || requested !== choice.dataset.inForce) choice.value = requested;
  choice.dataset.inForce = requested;
}

function showStages(stages) {
  const rows = Object.entries(stages);
  const longest = Math.max(1, ...rows.map(([, times]) => times?.p99 ?? 0));
  const box = byId("stages");
  fit(box, rows.length, () => {
    const row = element("div");
    const bar = element("span");
    bar.className = "bar";
    bar.append(element("i"), element("i"));
    row.append(element("span"), bar, element("span"));
    return row;
  });
  rows.forEach(([name, times], i) => {
    const [label, bar, text] = box.children[i].children;
    setText(label, name.replaceAll("_", " "));
    setText(text, `${fixed(times?.p50, 1)}, ${fixed(times?.p99, 1)} ms`);
    bar.children[0].style.width = `${(100 * (times?.p99 ?? 0)) / longest}%`;
    bar.children[1].style.width = `${(100 * (times?.p50 ?? 0)) / longest}%`;
  });
}

function showChannels({ state, ports, rates, events, companions = {}, companion_words: words, issues = [] }, isCurrent) {
  const lines = issues.map(({ severity, what, next_step: step }) =>
    [severity === "error" ? "bad" : "warn", what, step]);
  const stands = ["paused", "ended"].includes(state);
  for (const name of ["magnitude", "structure"]) {
    const hz = rates?.[`${name}_hz`];
    if (hz === null || hz === undefined) continue;
    lines.push([hz > 0 || stands ? "good" : "bad", name,
      stands ? state : hz > 0 ? `${fixed(hz, 1)} scans/s` : "no scans"]);
  }
  for (const [name, { state: does }] of Object.entries(companions)) {
    lines.push([{ fitted: "good", disputed: "bad", missing: "bad" }[does] ?? "", name, words[name]]);
  }
  for (const { url, state: does, device, bytes: received } of ports ?? []) {
    lines.push(["", url, [does, device?.device_id, bytes(received)].filter(Boolean).join(", ")]);
  }
  // What happened before this page was opened is among them.
  for (const { name, severity, age_s: age } of events?.troubles ?? []) {
    if (age > TROUBLE_SHOWN_S) continue;
    const kind = severity === "error" ? "bad" : "warn";
    lines.push([kind, name.replaceAll("_", " "), `${events.counts[name]} ×, last ${age < 60 ? seconds(1000 * age) : `${fixed(age / 60, 0)} min`} ago`]);
  }
  if (!isCurrent) lines.splice(0, Infinity, ...lines.map(([, name]) => ["", name, "not known"]));
  const list = byId("channels");
  fit(list, lines.length, () => {
    const item = element("li");
    item.append(element("span"), element("span"), element("span"));
    item.children[0].className = "dot";
    return item;
  });
  lines.forEach(([kind, name, text], i) => {
    list.children[i].className = i < issues.length || name.length > 24 ? "issue" : "";
    const [dot, label, value] = list.children[i].children;
    dot.dataset.kind = kind;
    Object.assign(dot, { title: kind, role: "img", ariaLabel: kind || "no verdict" });
    setText(label, name);
    setWords(value, text);
  });
}

/** Take an event into the list, happened at `at`, ms since 1970; `go()` shows that moment. */
export function showEvent(event, at, go) {
  const item = element("li");
  item.dataset.severity = event.severity;
  item.dataset.name = event.name;
  const button = element("button");
  Object.assign(button, { type: "button", title: "Show this moment", onclick: go });
  const severity = element("span", ["warning", "error"].includes(event.severity) ? event.severity : "");
  severity.className = "unseen";
  button.append(element("time", new Date(at).toLocaleTimeString()), severity,
    element("strong", String(event.name).replaceAll("_", " ")));
  const words = element("span");
  setWords(words, [event.detail, event.next_step].filter(Boolean).join("; "));
  item.append(button, words);
  const list = byId("events");
  list.prepend(item);
  while (list.children.length > EVENTS_SHOWN) list.lastChild.remove();
  byId("no-events").hidden = true;
}

function fit(parent, count, make) {
  while (parent.children.length > count) parent.lastElementChild.remove();
  while (parent.children.length < count) parent.append(make());
}

function element(tag, text = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  return made;
}

// Untouched text keeps its selection and spares screen readers.
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Show a text in which `commands` stand in backticks. */
export function setWords(node, text) {
  if (node.dataset.words === text) return;
  node.dataset.words = text;
  node.replaceChildren(...text.split("`").map((part, i) => (i % 2 ? element("code", part) : part)));
}

function clock(realtimeNs) {
  return realtimeNs ? new Date(realtimeNs / 1e6).toLocaleTimeString() : "";
}

function bytes(count) {
  if (!(count >= 1000)) return `${count ?? 0} B`;
  const power = Math.min(3, Math.floor(Math.log10(count) / 3));
  return `${fixed(count / 1000 ** power, 1)}\u00a0${["B", "kB", "MB", "GB"][power]}`;
}
