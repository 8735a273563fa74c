// The last minute: its frames, to look back at, and a strip of how hard each contact pressed. A band
// is an uncertainty or a bound, hatched what is not known, shaded a time without frames.

import { contactColour } from "./colormap.js";
import { areTouchesSeen } from "./health.js";
import { line, number, theme, ticks } from "./map_view.js";
import { UNITS, fixed, forceOf, pressureOf, pressureText, quantityText, seconds } from "./values.js";

const KEPT_MS = 60_000;
const SHORTEST_MS = 5_000;  // of what is shown
const ZOOM = 1.5;
const SPACING_MS = 45;  // of the frames kept: 20 a second are some 40 MB of images a minute
const EVENT_REACH_PX = 6;
const LANE = { left: 52, right: 14, gap: 10, bottom: 18 };

export class Timeline {
  /** `onLook()` is called when another moment is to be shown. Times are in ms, of performance.now(). */
  constructor({ canvas, slider, onLook }) {
    Object.assign(this, { canvas, slider, onLook });
    this.frames = [];      // {at, frame, stood}, oldest first; `stood`: a replay waited at this one
    this.events = [];      // {at, name, severity}
    this.pausedAt = null;  // the newest moment while it stands still
    this.spanMs = KEPT_MS;
    this.end = 0;          // the strip's right end
    this.pointer = null;   // its x on the strip, px
    this.hatches = {};
    slider.min = -KEPT_MS;
    slider.step = 50;
    slider.oninput = () => this.#look();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.#scrub(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      this.pointer = event.offsetX;
      this.#scrub(event);
    });
    canvas.addEventListener("pointerleave", () => { this.pointer = null; });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(event.deltaY < 0, this.#time(event.offsetX));
    }, { passive: false });
  }

  add(frame) {
    const at = frame.receivedAt - frame.age_ms;
    this.#closeUp(at);
    if (at - (this.frames.at(-1)?.at ?? -Infinity) < SPACING_MS) return;
    this.frames.push({ at, frame });
    const isKept = (item) => item.at > at - KEPT_MS || this.#isBeforePause(item.at);
    if (!isKept(this.frames[0])) this.frames = this.frames.filter(isKept);
    this.events = this.events.filter(isKept);
  }

  /** Take it that a replay waits at the newest frame: the strip leaves this time out. */
  stand() {
    const newest = this.frames.at(-1);
    if (newest) newest.stood = true;
  }

  /** Take an event that happened at `at`. */
  note({ name, severity }, at) {
    this.events.push({ at, name: name.replaceAll("_", " "), severity });
  }

  get isPaused() {
    return this.pausedAt !== null;
  }

  pause() {
    const newest = this.frames.at(-1);
    this.pausedAt ??= newest?.stood ? newest.at : performance.now();
  }

  goLive() {
    this.pausedAt = null;
    this.slider.value = 0;
    this.slider.ariaValueText = "now";
    this.onLook();
  }

  /** Look back at a moment; false where no frame of it is kept. */
  lookAt(at) {
    if (!(this.frames[0]?.at <= at)) return false;
    this.#lookAt(at);
    return true;
  }

  /** Show a shorter time, or a longer one, around a moment; the right end stays at the newest. */
  zoom(isCloser, moment = this.#moment) {
    const before = this.spanMs;
    this.spanMs = Math.min(KEPT_MS, Math.max(SHORTEST_MS, isCloser ? before / ZOOM : before * ZOOM));
    this.end = moment + ((this.end - moment) * this.spanMs) / before;
    this.onLook();
  }

  /**
   * The frame of the moment looked at, {at, frame, isKnown}; null where that is now, or there is none.
   * It is not known what was in an outage: the frame is that of before.
   */
  get shown() {
    const found = this.isPaused && (this.#frameAt(this.#moment) ?? this.frames[0]);
    return found ? { ...found, isKnown: this.#moment - found.at <= this.options.gapMs } : null;
  }

  /** What was at the pointer, or at the moment looked at, in words; nothing where there is neither. */
  get readout() {
    if ((this.pointer === null && !this.isPaused) || !this.options) return "";
    const at = this.pointer === null ? this.#moment : this.#time(this.pointer);
    const found = this.#frameAt(at);
    const { unit, gapMs } = this.options;
    const contacts = !found || at - found.at > gapMs ? ["no data"]
      : found.frame.contacts.map((contact) => {
        const force = quantityText(forceOf(contact), 0);
        return `${contact.id}: ${pressureText(contact, unit)}${force ? `, ${force} N` : ""}`;
      });
    const near = this.events.filter((event) => Math.abs(this.#x(event.at) - this.#x(at)) < EVENT_REACH_PX);
    const ago = seconds(Math.max(0, (this.pausedAt ?? this.end) - at));
    return [ago === seconds(0) ? ago : `−${ago}`, ...contacts, ...near.map(({ name }) => name)].join(" · ");
  }

  /**
   * Draw the strip up to `end`, or to the pause: pressure in `unit` above force. Frames further apart
   * than `gapMs` are not joined.
   */
  draw(options) {
    this.options = options;
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
    this.#keepInView(options.end);
    const { left, width: wide, bottom } = this.lanes = this.#lanes();
    const frames = this.frames.filter(({ at }) => at > this.end - this.spanMs - options.gapMs && at <= this.end);
    this.#seconds(c);
    c.save();
    c.beginPath();
    c.rect(left, 0, wide, bottom);
    c.clip();
    this.#outages(c, frames);
    const scales = [
      this.#lane(c, 0, frames, (contact) => pressureOf(contact, options.unit)),
      this.#lane(c, 1, frames, forceOf),
    ];
    for (const { at, severity } of this.events) this.#event(c, at, severity);
    c.strokeStyle = this.theme.text;
    c.lineWidth = 1.5;
    if (this.isPaused) this.#upright(c, this.#x(this.#moment));
    c.lineWidth = 0.75;
    if (this.pointer !== null) this.#upright(c, this.pointer);
    c.restore();
    this.#axis(c, 0, scales[0], UNITS[options.unit][0]);
    this.#axis(c, 1, scales[1], "N");
  }

  get #moment() {
    return this.isPaused ? this.pausedAt + Number(this.slider.value) : this.end;
  }

  // Move what was before a wait of the replay on to the frame that ends it.
  #closeUp(at) {
    const newest = this.frames.at(-1);
    const wait = newest?.stood ? at - newest.at - SPACING_MS : 0;
    if (!(wait > this.options?.gapMs)) return;
    for (const item of [...this.frames, ...this.events]) item.at += wait;
    if (!this.isPaused) return;
    this.pausedAt += wait;
    this.end += wait;
  }

  #frameAt(moment) {
    return this.frames.findLast(({ at }) => at <= moment);
  }

  #scrub({ offsetX, buttons }) {
    if (buttons) this.#lookAt(this.#time(offsetX));
  }

  #lookAt(at) {
    this.pause();
    this.slider.value = Math.round(at - this.pausedAt);
    this.#look();
  }

  #look() {
    this.pause();
    const ago = -Number(this.slider.value) / 1000;
    this.slider.ariaValueText = ago ? `${fixed(ago, 1)} s before the pause` : "at the pause";
    this.onLook();
  }

  #isBeforePause(at) {
    return this.isPaused && at <= this.pausedAt && at > this.pausedAt - KEPT_MS;
  }

  // Live it ends now; while it stands still it may be moved as far as there are frames.
  #keepInView(now) {
    if (!this.isPaused) {
      this.end = now;
      return;
    }
    const moment = this.#moment;
    this.end = Math.min(Math.max(this.end, moment), moment + this.spanMs);
    this.end = Math.min(Math.max(this.end, this.pausedAt - KEPT_MS + this.spanMs), this.pausedAt);
  }

  #lanes() {
    const { clientWidth, clientHeight } = this.canvas;
    const bottom = clientHeight - LANE.bottom;
    return { left: LANE.left, width: clientWidth - LANE.left - LANE.right, bottom,
      height: (bottom - LANE.gap) / 2 };
  }

  #x(at) {
    const { left, width } = this.#lanes();
    return left + width * (1 + (at - this.end) / this.spanMs);
  }

  #time(x) {
    const { left, width } = this.#lanes();
    return this.end + ((x - left) / width - 1) * this.spanMs;
  }

  #upright(c, x) {
    line(c, x, 0, x, this.lanes.bottom);
  }

  #seconds(c) {
    const { lanes } = this;
    const newest = this.pausedAt ?? this.end;
    const oldest = (newest - this.end + this.spanMs) / 1000;
    c.fillStyle = this.theme.dim;
    c.strokeStyle = this.theme.line;
    c.textBaseline = "top";
    c.lineWidth = 1;
    for (const ago of ticks(oldest - this.spanMs / 1000, oldest, lanes.width > 400 ? 6 : 3)) {
      const x = this.#x(newest - 1000 * ago);
      c.textAlign = ago ? "center" : "right";
      this.#upright(c, x);
      c.fillText(ago ? `−${number(ago)} s` : this.isPaused ? "pause" : "now", x + (ago ? 0 : LANE.right), lanes.bottom + 5);
    }
  }

  // Times without frames, with how long they were, and those of which no contacts say nothing.
  #outages(c, frames) {
    const { gapMs } = this.options;
    const ends = [...frames.slice(1).map(({ at }) => at), this.end];
    frames.forEach(({ at, frame }, i) => {
      const isGap = ends[i] - at > gapMs;
      if (!isGap && areTouchesSeen(frame)) return;
      const [x0, x1] = [this.#x(at), this.#x(ends[i])];
      c.fillStyle = this.#hatch(isGap ? this.theme.axis : this.theme.warn);
      c.fillRect(x0, 0, x1 - x0, this.lanes.bottom);
      const text = `no data for ${seconds(ends[i] - at)}`;
      if (!isGap || c.measureText(text).width + 8 > x1 - x0) return;
      const [x, y, room] = [(x0 + x1) / 2, this.lanes.height / 2, c.measureText(text).width + 8];
      c.fillStyle = this.theme.background;
      c.fillRect(x - room / 2, y - 8, room, 16);
      c.fillStyle = this.theme.text;
      c.textAlign = "center";
      c.textBaseline = "middle";
      c.fillText(text, x, y);
    });
  }

  /** Draw one quantity of all contacts, and return the lane's scale: {base, full, top}. */
  #lane(c, which, frames, read) {
    const base = which ? this.lanes.bottom : this.lanes.height;
    const byContact = new Map();  // session and id -> points
    let top = 0;
    for (const { at, frame } of frames) {
      for (const contact of frame.contacts) {
        const key = `${frame.session} ${contact.id}`;
        if (!byContact.has(key)) byContact.set(key, { colour: contactColour(contact.id), points: [] });
        const point = { at, ...read(contact) };
        byContact.get(key).points.push(point);
        top = Math.max(top, point.high < Infinity ? point.high : point.low);
      }
    }
    const full = Math.max(1.15 * top, ticks(0, 1.15 * top || 1, 2).at(-1));
    const y = (value) => base - (Math.min(value, full) / full) * this.lanes.height;
    for (const { colour, points } of byContact.values()) {
      for (const run of this.#runs(points)) this.#run(c, run, colour, y);
    }
    return { base, full, top };
  }

  // Points that are joined: without a gap, and either all known or none.
  #runs(points) {
    const runs = [];
    let before = null;
    for (const point of points) {
      const goesOn = before && point.at - before.at <= this.options.gapMs
        && (point.value === null) === (before.value === null);
      if (goesOn) runs.at(-1).push(point);
      else runs.push([point]);
      before = point;
    }
    return runs;
  }

  #run(c, run, colour, y) {
    const isKnown = run[0].value !== null;
    const x = run.map(({ at }) => this.#x(at));
    c.beginPath();
    run.forEach(({ high }, i) => c.lineTo(x[i], y(high)));
    c.lineTo(x.at(-1) + 1, y(run.at(-1).high));
    run.toReversed().forEach(({ low }, i) => c.lineTo(x.at(-1 - i), y(low)));
    c.globalAlpha = isKnown ? 0.3 : 0.7;
    c.fillStyle = isKnown ? colour : this.#hatch(colour);
    c.fill();
    c.globalAlpha = 1;
    if (!isKnown) return;
    c.beginPath();
    run.forEach(({ value }, i) => c.lineTo(x[i], y(value)));
    c.lineTo(x.at(-1) + 1, y(run.at(-1).value));
    c.strokeStyle = colour;
    c.lineWidth = 2;
    c.stroke();
  }

  #hatch(colour) {
    return (this.hatches[colour] ??= hatch(colour));
  }

  #axis(c, which, { base, full, top }, unit) {
    const { lanes } = this;
    c.fillStyle = this.theme.dim;
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const mark of top ? ticks(0, full, 2).slice(1) : []) {
      c.fillText(number(mark), lanes.left - 6, Math.max(6, base - (mark / full) * lanes.height));
    }
    c.fillText(unit, lanes.left - 6, base - 5);
    c.strokeStyle = this.theme.axis;
    c.lineWidth = 1;
    line(c, lanes.left, base, lanes.left + lanes.width, base);
  }

  #event(c, at, severity) {
    const x = this.#x(at);
    c.strokeStyle = c.fillStyle = { warning: this.theme.warn, error: this.theme.bad }[severity] ?? this.theme.accent;
    c.lineWidth = 1;
    c.globalAlpha = 0.4;
    this.#upright(c, x);
    c.globalAlpha = 1;
    c.beginPath();
    c.moveTo(x - 4, 0);
    c.lineTo(x + 4, 0);
    c.lineTo(x, 7);
    c.fill();
  }
}

function hatch(colour) {
  const tile = new OffscreenCanvas(6, 6);
  const c = tile.getContext("2d");
  c.strokeStyle = colour;
  for (const shift of [-6, 0, 6]) line(c, shift - 1, 7, shift + 7, -1);
  return c.createPattern(tile, "repeat");
}
