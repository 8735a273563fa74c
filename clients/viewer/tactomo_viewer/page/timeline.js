// The last minute: its frames, to look back at, and a strip of how hard each contact pressed, with
// the events on it.

import { line, number, theme, ticks } from "./map_view.js";

const KEPT_MS = 60_000;
const SPACING_MS = 45;  // of the frames kept: 20 a second are some 40 MB of images a minute
const EVENT_REACH_PX = 6;
const LANE = { left: 52, right: 14, gap: 12, bottom: 20 };
// Okabe and Ito's colours, which the colour-blind tell apart, without black and yellow.
const COLOURS = ["#e69f00", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2"];

export class Timeline {
  /** `onLook()` is called when another moment is to be shown. Times are in ms, of performance.now(). */
  constructor({ canvas, slider, onLook }) {
    Object.assign(this, { canvas, slider, onLook });
    this.frames = [];      // {at, frame}, oldest first
    this.events = [];      // {at, name, severity}
    this.pausedAt = null;  // the strip's right end while it stands still
    slider.min = -KEPT_MS;
    slider.step = 50;
    slider.oninput = () => this.#look();
    const scrub = ({ offsetX, buttons }) => {
      if (!buttons) return;
      const { left, width } = this.#lanes();
      this.pause();
      slider.value = Math.round(((offsetX - left) / width - 1) * KEPT_MS);
      this.#look();
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      scrub(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      canvas.title = this.#eventsAt(event.offsetX).join(", ");
      scrub(event);
    });
  }

  add(frame) {
    const at = frame.receivedAt - frame.age_ms;
    if (at - (this.frames.at(-1)?.at ?? -Infinity) < SPACING_MS) return;
    this.frames.push({ at, frame });
    const isKept = (item) => item.at > at - KEPT_MS || this.#isBeforePause(item.at);
    if (!isKept(this.frames[0])) this.frames = this.frames.filter(isKept);
    this.events = this.events.filter(isKept);
  }

  note({ name, severity, acquired_realtime_ns: ns }) {
    const at = ns / 1e6 - Date.now() + performance.now();
    this.events.push({ at, name: name.replaceAll("_", " "), severity });
  }

  get isPaused() {
    return this.pausedAt !== null;
  }

  pause() {
    this.pausedAt ??= performance.now();
  }

  goLive() {
    this.pausedAt = null;
    this.slider.value = 0;
    this.onLook();
  }

  /** The frame of the moment looked at, {at, frame}; null where that is now, or before all frames. */
  get shown() {
    if (!this.isPaused) return null;
    const moment = this.pausedAt + Number(this.slider.value);
    return this.frames.findLast(({ at }) => at <= moment) ?? this.frames[0] ?? null;
  }

  /**
   * Draw the strip up to `end`, or to the pause. `value(contact)` is drawn in `unit` above the force;
   * frames further apart than `gapMs` are not joined.
   */
  draw({ end, unit, value, gapMs }) {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
    if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
    const c = canvas.getContext("2d");
    this.theme = theme(canvas);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    c.font = `11px ${this.theme.font}`;
    this.end = this.pausedAt ?? end;
    const frames = this.frames.filter(({ at }) => at > this.end - KEPT_MS && at <= this.end);
    const lanes = this.#lanes();
    this.#seconds(c, lanes);
    this.#lane(c, lanes, 0, unit, frames, value, gapMs);
    this.#lane(c, lanes, 1, "N", frames, ({ force_n: force }) => force, gapMs);
    for (const { at, severity } of this.events) this.#event(c, lanes, at, severity);
    if (this.isPaused) {
      const x = this.#x(lanes, this.pausedAt + Number(this.slider.value));
      c.strokeStyle = this.theme.text;
      c.lineWidth = 1.5;
      line(c, x, 0, x, lanes.bottom);
    }
  }

  #look() {
    this.pause();
    const seconds = -Number(this.slider.value) / 1000;
    this.slider.ariaValueText = seconds ? `${seconds.toFixed(1)} s before the pause` : "at the pause";
    this.onLook();
  }

  #isBeforePause(at) {
    return this.isPaused && at <= this.pausedAt && at > this.pausedAt - KEPT_MS;
  }

  #lanes() {
    const { clientWidth, clientHeight } = this.canvas;
    const bottom = clientHeight - LANE.bottom;
    return { left: LANE.left, width: clientWidth - LANE.left - LANE.right, bottom,
      height: (bottom - LANE.gap) / 2 };
  }

  #x({ left, width }, at) {
    return left + width * (1 + (at - this.end) / KEPT_MS);
  }

  #eventsAt(px) {
    const lanes = this.#lanes();
    return this.events.filter(({ at }) => Math.abs(this.#x(lanes, at) - px) < EVENT_REACH_PX)
      .map(({ name }) => name);
  }

  #seconds(c, lanes) {
    c.fillStyle = this.theme.dim;
    c.strokeStyle = this.theme.line;
    c.textBaseline = "top";
    c.lineWidth = 1;
    const seconds = lanes.width > 400 ? 10 : 20;
    for (let ago = 60; ago >= 0; ago -= seconds) {
      const x = this.#x(lanes, this.end - 1000 * ago);
      c.textAlign = ago ? "center" : "right";
      line(c, x, 0, x, lanes.bottom);
      c.fillText(ago ? `−${ago} s` : this.isPaused ? "pause" : "now", x + (ago ? 0 : LANE.right), lanes.bottom + 6);
    }
  }

  #lane(c, lanes, which, unit, frames, value, gapMs) {
    const base = which ? lanes.bottom : lanes.height;
    let top = 0;
    const byContact = new Map();  // session and id -> [at, value or null] each
    for (const { at, frame } of frames) {
      for (const contact of frame.contacts) {
        const key = `${frame.session} ${contact.id}`;
        if (!byContact.has(key)) byContact.set(key, { id: contact.id, points: [] });
        const here = value(contact);
        byContact.get(key).points.push([at, here]);
        if (here > top) top = here;
      }
    }
    const marks = ticks(0, 1.25 * top || 1, 2);
    const full = Math.max(1.25 * top, marks.at(-1));
    c.fillStyle = this.theme.dim;
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const mark of top ? marks.slice(1) : []) {
      c.fillText(number(mark), lanes.left - 6, Math.max(6, base - (mark / full) * lanes.height));
    }
    c.fillText(unit, lanes.left - 6, base - 5);
    c.strokeStyle = this.theme.axis;
    c.lineWidth = 1;
    line(c, lanes.left, base, lanes.left + lanes.width, base);
    for (const { id, points } of byContact.values()) {
      c.strokeStyle = COLOURS[id % COLOURS.length];
      c.lineWidth = 2;
      c.beginPath();
      let before = -Infinity;
      for (const [at, here] of points) {
        const [x, y] = [this.#x(lanes, at), base - ((here ?? 0) / full) * lanes.height];
        if (at - before > gapMs) c.moveTo(x, y);
        else c.lineTo(x, y);  // touched, but not known how hard: along the axis
        before = at;
      }
      c.stroke();
    }
  }

  #event(c, lanes, at, severity) {
    const x = this.#x(lanes, at);
    if (x < lanes.left || x > lanes.left + lanes.width) return;
    c.strokeStyle = c.fillStyle = { warning: this.theme.warn, error: this.theme.bad }[severity] ?? this.theme.accent;
    c.lineWidth = 1;
    c.setLineDash([3, 3]);
    line(c, x, 0, x, lanes.bottom);
    c.setLineDash([]);
    c.beginPath();
    c.moveTo(x - 4, 0);
    c.lineTo(x + 4, 0);
    c.lineTo(x, 7);
    c.fill();
  }
}
