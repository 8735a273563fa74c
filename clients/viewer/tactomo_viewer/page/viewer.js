// The page's main part: takes what the link brings, and has it drawn once a screen refresh.

import { ageOf, areTouchesSeen, isHeard, isMapCurrent, staleAfter, verdict } from "./health.js";
import { Idle } from "./idle.js";
import { Link } from "./link.js";
import { MapView } from "./map_view.js";
import { byId, setText, setWords, showContacts, showEvent, showHeld, showQuality, showState, showStatus } from "./panels.js";
import { Replay } from "./replay.js";
import { Timeline } from "./timeline.js";
import { Touch } from "./touch.js";
import { UNITS, fixed, pressureOf, pressureText, seconds } from "./values.js";

const PANEL_MS = 100;       // how often the texts beside the map change
const FALLBACK_TOP = { kpa: 300, percent: 30 };
const PAINTED = 120;        // frames that rate and latency are taken over
const SPOKEN_MS = 1000;     // how long words stay before they are spoken
const NEAR_MM = 10;         // beyond a press's rim a contact is another's

const state = {
  hello: null,
  openedAt: 0,
  frame: null,              // the newest
  drawn: null,              // the one on the canvas
  status: null,             // {fields, age_ms, receivedAt}
  twin: { answers: false, others_press: false },
  isCurrent: false,         // whether the map may be read
  painted: [],              // {at, latency} of the last frames, ms
  fitted: { kpa: 0, percent: 0 },
  awaited: null,            // the press whose picture is awaited
  taredAt: -Infinity,       // when the daemon last said that it tares
  get stoodAt() { return Math.max(replay.stoodAt, state.taredAt); },
  get isMoving() { return replay.isBefore(state.frame); },
};

const view = new MapView(byId("map"));
const link = new Link({ onFrame, onMessage, onChange: onLink });
state.link = link;
const touch = new Touch({
  view, link, indenter,
  onChange: () => {
    showHeld(touch.held, (press) => touch.drop(press));
    redraw();
  },
  onPress: (press) => {
    idle.stop();
    if (!contactNear(press)) state.awaited = { ...press, at: performance.now() };
  },
});
const timeline = new Timeline({
  canvas: byId("strip"),
  slider: byId("moment"),
  onLook: () => { redraw(); refresh(); },
});
const replay = new Replay(command);
const idle = new Idle({
  touch,
  range: () => ({ x: view.sheet.x[1], y: view.sheet.y[1], kpa: scaleTop(null, "kpa") }),
});

// For those who drive this page from outside, such as its tests.
window.tactomo = {
  touch,
  timeline,
  idle,
  labels: () => view.labels,
  mmToPixel: (x, y) => view.mmToPixel(x, y),
  pixelToMm: (x, y) => view.pixelToMm(x, y),
  state,
};

// What comes

function onFrame(frame) {
  if (state.drawn?.session !== frame.session) state.fitted = { kpa: 0, percent: 0 };
  state.frame = frame;
  timeline.add(frame);
  redraw();
}

// The frame that the page shows: the newest, or one that is looked back at.
function shownFrame() {
  return timeline.shown?.frame ?? state.frame;
}

function onMessage(message) {
  const handlers = {
    hello: () => {
      state.hello = message;
      setText(byId("sensor"), message.sensor);
      document.title = `${message.sensor} · tactomo`;
      byId("events").replaceChildren();  // the server sends the recent ones again
      timeline.events = [];
    },
    status: () => {
      // Taken, it tells that the daemon is there, however long it waited in this page.
      state.status = { fields: message.status, age_ms: message.age_ms, receivedAt: performance.now() };
      if (message.status.state === "taring") state.taredAt = performance.now();
      describe(message.status.description);
      showStatus(message.status, true);
      replay.show(state.status, state.hello, state.drawn !== null);
    },
    event: () => {
      const at = message.receivedAt - message.age_ms;
      const position = replay.positionAt(at);
      showEvent(message.event, Date.now() - (performance.now() - at), () => goTo(at, position));
      timeline.note(message.event, at);
    },
    twin: () => { state.twin = message; },
  };
  handlers[message.type]?.();
  refresh();
}

function onLink() {
  state.openedAt = performance.now();
  if (!link.isOpen) state.twin = { answers: false, others_press: false };
  refresh();
}

let surface = null;         // the view of a mounted sheet on its surface, once there is one
let mounted = "";

// What draws surfaces is loaded by those who have one.
async function showMount(mount) {
  const key = JSON.stringify(mount ?? null);
  if (key === mounted) return;
  mounted = key;
  const room = byId("surface-room");
  room.hidden = !mount;
  room.parentElement.classList.toggle("mounted", Boolean(mount));
  view.resize();
  if (!mount) return;
  const turn = "drag beside the sheet to turn it, or use the arrow keys";
  setText(byId("surface-help"), `${mount.frame}: loading the surface`);
  try {
    const { SurfaceView } = await import("./surface_view.js");
    if (!surface) {
      surface = new SurfaceView(byId("surface"), view, redraw);
      touch.add(surface);
      window.tactomo.surface = surface;
    }
    surface.describe(mount);
    surface.resize();
    setText(byId("surface-help"), `${mount.frame}: ${turn}`);
  } catch (error) {
    setText(byId("surface-help"), `The surface cannot be drawn: ${error.message} Turn on WebGL in this browser.`);
  }
  redraw();
}

let described = "";

function describe(description) {
  const key = JSON.stringify(description ?? null);
  if (key === described || !description) return;
  described = key;
  view.describe(description);
  showMount(description.mount);
  byId("pressure").max = Math.max(300, description.pressure_max_kpa ?? 0);
  const hasPressure = description.pressure_max_kpa !== null;
  if (!hasPressure) choose("unit", "percent");
  document.querySelector("input[name=unit][value=kpa]").disabled = !hasPressure;
  redraw();
}

// Drawing

let scheduled = false;

function redraw() {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    draw();
  });
}

function draw() {
  const frame = shownFrame();
  const unit = chosen("unit");
  const image = imageIn(frame, unit);
  const scene = {
    frame,
    image,
    scale: image ? scaleTop(image, unit) : 1,
    unit: unit === "kpa" ? "kPa" : "Δσ/σ₀ %",
    label: (contact) => pressureText(contact, unit),
    colormap: byId("colormap").value,
    smooth: byId("smooth").checked,
    outline: byId("outline").checked,
    presses: touch.presses,
    cursor: touch.cursor,
    marked: Number(document.querySelector("#contacts tr:is(:hover, :focus-within)")?.dataset.id),
  };
  view.draw(scene);
  if (!byId("surface-room").hidden) surface?.draw(scene);
  if (frame === state.drawn) return;
  state.drawn = frame;
  showReadout();
  showError(frame);
  if (frame === state.frame) notePainted(frame);
}

function notePainted(frame) {
  const now = performance.now();
  state.painted.push({ at: now, latency: ageOf(frame, now) });
  if (state.painted.length > PAINTED) state.painted.shift();
  const { awaited } = state;
  if (awaited && contactNear(awaited)) {
    setText(byId("press-latency"), `${fixed(now - awaited.at, 0)} ms`);
    byId("press-latency").parentElement.hidden = false;
    state.awaited = null;
  }
}

function imageIn(frame, unit) {
  if (!frame) return null;
  if (unit === "kpa") return frame.images.pressure_kpa ?? null;
  const { map } = frame.images;
  return map ? { ...map, values: map.values.map((value) => 100 * value) } : null;
}

// "sensor": the range that the sensor has. "fit": the largest value lately, slowly forgotten.
function scaleTop(image, unit) {
  const description = state.status?.fields.description ?? {};
  const top = unit === "kpa" ? description.pressure_max_kpa : 100 * description.magnitude_max;
  const full = top > 0 ? top : FALLBACK_TOP[unit];
  if (!image || chosen("scale") === "sensor") return full;
  let largest = 0;
  for (const value of image.values) if (value > largest) largest = value;
  state.fitted[unit] = Math.max(largest, 0.98 * state.fitted[unit], full / 50);
  return state.fitted[unit];
}

// What is pressed, and what is felt of it

function contactNear({ x, y, size }) {
  return state.drawn?.contacts.some(
    (contact) => Math.hypot(contact.x_mm - x, contact.y_mm - y) < size / 2 + 5,
  );
}

// How far contacts are from the presses of this page as these were when the frame was measured.
function showError(frame) {
  const at = frame && state.isCurrent ? frame.receivedAt - frame.age_ms : 0;
  const errors = touch.presses.map((press) => Touch.wasAt(press, at)).filter(Boolean).map((press) => {
    const [off, contact] = (frame?.contacts ?? [])
      .map((each) => [Math.hypot(each.x_mm - press.x, each.y_mm - press.y), each])
      .sort(([a], [b]) => a - b)[0] ?? [Infinity];
    if (off > press.size / 2 + NEAR_MM) return null;
    const { value } = pressureOf(contact, "kpa");
    return { mm: off, kpa: value === null ? null : value - press.pressure };
  });
  const felt = errors.filter(Boolean);
  const worst = (values) => values.filter((value) => value !== null).sort((a, b) => Math.abs(b) - Math.abs(a))[0];
  const [mm, kpa] = [worst(felt.map((each) => each.mm)), worst(felt.map((each) => each.kpa))];
  const sizes = [mm !== undefined && `${fixed(mm, 1)} mm`, kpa !== undefined && `${fixed(kpa, 0)} kPa`];
  const unfelt = errors.length - felt.length;
  const words = [felt.length && `error ${sizes.filter(Boolean).join(", ")}`, unfelt && `${unfelt} not felt`];
  setText(byId("error"), words.filter(Boolean).join(" · "));
}

// Texts and banner

function refresh() {
  const now = performance.now();
  const live = verdict(state, now);
  const past = timeline.shown;
  const found = past && live?.level !== "error" ? pausedBanner(past, now) : live;
  showBanner(found);
  state.isCurrent = past?.isKnown ?? isMapCurrent(found);
  for (const id of ["map", "surface"]) byId(id).classList.toggle("stale", !state.isCurrent);
  document.body.dataset.health = found?.name ?? (state.status && state.frame ? "good" : "connecting");
  const linked = isHeard(state, now);
  if (linked) showState(["stale", "ended"].includes(live?.name) ? live.name : state.status.fields.state);
  else if (live?.level === "error") showState("gone", "disconnected");
  else showState("connecting");
  if (!linked && state.status) showStatus(state.status.fields, false);
  for (const id of ["tare", "record", "method"]) {
    byId(id).disabled = !linked || Boolean(state.hello?.read_only)
      || (id === "tare" && Boolean(state.status.fields.replay?.exact));
  }
  const canPress = link.isOpen && state.twin.answers && state.status?.fields.source?.kind === "twin";
  if (canPress) byId("press-card").hidden = false;
  byId("pressed").hidden = byId("press-card").hidden;
  byId("press-controls").disabled = !canPress;
  touch.enable(Boolean(canPress));  // redraws when that changes
  if (state.twin.others_press) idle.stop();
  else if (state.hello?.press_itself && canPress && !found) idle.begin();
  else if (!canPress || found?.name === "taring") idle.stop(false);
  setText(byId("map-help"), found ? "" : helpText(canPress));
  showNumbers(now);
  showReadout();
  if (!state.isCurrent) showError(null);
  speak(found, now);
  const isPaused = timeline.isPaused;
  setText(byId("pause"), isPaused ? "Back to now" : "Pause");
  const stands = ["ended", "replay-paused"].includes(live?.name) && state.frame;
  if (stands) timeline.stand();
  timeline.draw({
    end: stands ? state.frame.receivedAt : now,
    unit: chosen("unit"),
    gapMs: staleAfter(state.status?.fields ?? {}, state.hello),
  });
  replay.tick(now);
}

// What stands in the banner's place while all is well.
function helpText(canPress) {
  const frame = shownFrame();
  const unit = chosen("unit");
  if (frame && !imageIn(frame, unit)) {
    if (frame.images.map && unit === "kpa") return "No pressure in this frame: choose Δσ/σ₀.";
    if (!frame.images.structure) return "No map in this frame.";
    const has = state.status?.fields.description?.modalities;
    if (has?.includes("magnitude") !== false) return "Magnitude missing: only where, not how hard.";
  }
  if (idle.isOn) return "The demo presses by itself: press the skin to take over.";
  return canPress
    ? "Press with mouse, fingers, or arrow keys and space bar; Shift holds the press."
    : "";
}

function pausedBanner({ frame, at, isKnown, stood }, now) {
  const detail = isKnown ? `The map shows the frame of ${seconds(now - at)} ago${stood ? "" : "; the skin goes on"}.`
    : `No data then: the newest frame before is of ${seconds(now - at)} ago.`;
  return { name: "paused", level: "info", title: "Looking back.", detail, frame };
}

let bannerShown = "";

function showBanner(found) {
  const box = byId("banner");
  box.hidden = !found;
  if (!found) {
    bannerShown = "";
    return;
  }
  // A counting clock in it must not be read out anew every time.
  const key = found.name + found.level + found.title;
  if (key !== bannerShown) {
    bannerShown = key;
    box.dataset.name = found.name;
    box.dataset.level = found.level;
    box.querySelector("strong").textContent = found.title;
  }
  setWords(box.querySelector("span"), found.detail);
}

let unspoken = { words: "", since: 0 };

// What a reader of the screen is to speak, once it has stayed for a while: what numbers count up or
// flicker between is not. The table has the contacts' values.
function speak(found, now) {
  const [title, detail] = [found?.title, found?.name === "paused" ? "" : found?.detail];
  const contacts = byId("count").textContent;
  const all = [
    title && `${title} ${detail}`.replace(/[\d.]+ s\b/g, "a while"),
    idle.isOn ? byId("map-help").textContent
      : contacts ? `${contacts} contact${contacts === "1" ? "" : "s"}` : byId("no-contacts").textContent,
    ...[...byId("quality").children].map(({ textContent: flag }) => (flag === "good" ? "" : flag)),
    touch.cursor && byId("readout").textContent,
  ];
  const words = all.filter(Boolean).join(", ").replace(/[.;:]\s*, /g, ". ");
  if (words !== unspoken.words) unspoken = { words, since: now };
  else if (now - unspoken.since > SPOKEN_MS) {
    unspoken.since = Infinity;
    byId("spoken").ariaLive = found?.level === "error" ? "assertive" : "polite";
    setWords(byId("spoken"), words);
  }
}

// Show the moment of an event: a replay stands there; of a live skin the last minute is kept.
function goTo(at, position) {
  if (position !== undefined && state.status.fields.replay) {
    timeline.goLive();
    replay.standAt(position);
  } else if (!timeline.lookAt(at)) {
    say("The page keeps no frame of that moment: only the last 60 s since it was opened.", false);
  }
}

function showNumbers(now) {
  const { painted, isCurrent } = state;
  const frame = shownFrame();
  const recent = painted.filter(({ at }) => now - at < 2000);
  const rate = recent.length > 1 ? (1000 * (recent.length - 1)) / (recent.at(-1).at - recent[0].at) : 0;
  setText(byId("rate"), rate ? `${fixed(rate, 1)} /s` : "–");
  const latencies = recent.map(({ latency }) => latency).sort((a, b) => a - b);
  const median = latencies[Math.floor(latencies.length / 2)];
  setText(byId("latency"), latencies.length ? `${fixed(median, 0)} ms` : "–");
  byId("latency").title = latencies.length
    ? `scan read to picture drawn, half of the frames; the slowest of the last 2 s: ${fixed(latencies.at(-1), 0)} ms`
    : "";
  const age = ageOf(frame, now);
  setText(byId("age"), age < 1e3 ? `${fixed(age, 0)} ms` : age < 1e6 ? `${fixed(age / 1e3, 1)} s` : "–");
  byId("age").classList.toggle("bad", !isCurrent);
  if (!frame) return;
  const known = isCurrent && !frame.flags.includes("no_reference");
  const contacts = known ? [...frame.contacts].sort((a, b) => a.id - b.id) : [];
  showContacts(contacts, chosen("unit"));
  setText(byId("no-contacts"), known && areTouchesSeen(frame) ? "Nothing pressed." : "Not known.");
  showQuality(frame, isCurrent);
  byId("map").ariaLabel = known && (contacts.length || areTouchesSeen(frame))
    ? `Pressure map, ${frame.contacts.length || "no"} contact${frame.contacts.length === 1 ? "" : "s"}`
    : "Pressure map, not known";
}

// Controls

function indenter() {
  return {
    pressure: Number(byId("pressure").value),
    size: Number(byId("size").value),
    shape: byId("shape").value,
  };
}

function showIndenter() {
  for (const [id, unit] of [["pressure", "kPa"], ["size", "mm"]]) {
    byId(id).ariaValueText = `${byId(id).value} ${unit}`;
    setText(byId(`${id}-value`), byId(id).ariaValueText);
  }
  touch.refresh();
  redraw();
}

async function command(name, args = {}, done = () => "") {
  const reply = await link.ask({ type: "command", command: name, arguments: args });
  const text = reply.ok
    ? done(reply.result)
    : [reply.error.cause, reply.error.next_step].filter(Boolean).join("; ");
  say(text, reply.ok);
  return reply.ok;
}

let silence = 0;

function say(text, ok) {
  const box = byId("message");
  setWords(box, text);
  box.classList.toggle("bad", !ok);
  clearTimeout(silence);
  silence = setTimeout(() => setWords(box, ""), 7000);
}

function chosen(name) {
  return document.querySelector(`input[name=${name}]:checked`).value;
}

function choose(name, value) {
  document.querySelector(`input[name=${name}][value=${value}]`).checked = true;
}

byId("tare").onclick = () =>
  command("tare", {}, ({ scans, contacts }) => `Tared: the reference is the mean of ${scans} scans.` +
    (contacts ? ` Shown meanwhile: ${contacts} contact${contacts === 1 ? "" : "s"}. Was something on the skin? Then tare again without it.` : ""));
byId("record").onclick = () =>
  state.status?.fields.recording
    ? command("record_stop", {}, ({ path }) => `Recorded to ${path}`)
    : command("record_start", {}, ({ path }) => `Recording to ${path}`);
byId("method").onchange = async ({ target }) => {
  const ok = await command("set_tier", { tier: target.value }, ({ tier }) => `Method: ${tier}`);
  if (!ok) target.value = target.dataset.inForce;
};
byId("pause").onclick = () => {
  if (timeline.isPaused) timeline.goLive();
  else timeline.pause();
  refresh();
};
byId("zoom-in").onclick = () => timeline.zoom(true);
byId("zoom-out").onclick = () => timeline.zoom(false);
byId("clear").onclick = () => touch.clear();
byId("hold").onchange = ({ target }) => { touch.hold = target.checked; };
for (const id of ["pressure", "size", "shape"]) byId(id).oninput = showIndenter;
for (const input of document.querySelectorAll("#view input, #view select, input[name=unit]")) {
  const [key, isCheck] = [input.name || input.id, input.type === "checkbox"];
  const before = kept(key);
  if (input.type === "radio") input.checked ||= before === input.value;
  else if (isCheck && before !== null) input.checked = before === "true";
  else if ([...input.options ?? []].some(({ value }) => value === before)) input.value = before;
  input.addEventListener("change", () => {
    kept(key, isCheck ? input.checked : input.value);
    redraw();
    refresh();
  });
}

// What somebody chose to see, for when the page is opened anew; null where a browser keeps nothing.
function kept(key, value) {
  try {
    if (value !== undefined) localStorage.setItem(key, value);
    return localStorage.getItem(key);
  } catch {
    return null;
  }
}

let pointer = null;  // where it is, in mm: what comes under it while it rests is read out, too

for (const id of ["map", "surface"]) {
  byId(id).addEventListener("pointermove", ({ offsetX, offsetY }) => {
    pointer = (id === "map" ? view : surface)?.pixelToMm(offsetX, offsetY);
    showReadout();
  });
  byId(id).addEventListener("pointerleave", () => {
    pointer = null;
    showReadout();
  });
}
for (const event of ["pointermove", "pointerleave"]) byId("strip").addEventListener(event, refresh);
for (const event of ["pointerover", "pointerout", "focusin", "focusout"]) byId("contacts").addEventListener(event, redraw);

function showReadout() {
  const place = pointer ?? touch.cursor;
  setText(byId("readout"), place && view.isOnSheet(...place) ? readout(...place) : timeline.readout);
}

function readout(x, y) {
  const unit = chosen("unit");
  const frame = shownFrame();
  const place = `x ${fixed(x, 0)}, y ${fixed(y, 0)} mm`;
  const image = state.isCurrent ? imageIn(frame, unit) : null;
  if (!image) return place;
  const { x_mm: [x0, x1], y_mm: [y0, y1] } = frame;
  const ix = Math.round(((x - x0) / (x1 - x0)) * (image.nx - 1));
  const iy = Math.round(((y - y0) / (y1 - y0)) * (image.ny - 1));
  const value = image.values[iy * image.nx + ix];
  const [name, decimals] = UNITS[unit];
  return Number.isFinite(value) ? `${place}: ${fixed(value, decimals)} ${name}` : place;
}

new ResizeObserver(() => { view.resize(); surface?.resize(); redraw(); }).observe(byId("map").parentElement);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
setInterval(refresh, PANEL_MS);
showIndenter();
redraw();
