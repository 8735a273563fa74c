// The controls of a replay: they ask the daemon, and show what its status says.

import { byId, setText } from "./panels.js";
import { fixed } from "./values.js";

const REMEMBERED_MS = 10_000;

export class Replay {
  /** `command(name, arguments)` asks the daemon, and tells what it refuses. */
  constructor(command) {
    this.command = command;
    this.fields = null;
    this.stoodAt = -Infinity;  // until when no frame was to come
    this.moves = null;  // where it is to go on, until that is answered
    this.stood = [];  // {at, position_s}: where it was in the last while
    byId("play").onclick = () => this.#ask(
      this.#hasEnded ? { position_s: 0, paused: false } : { paused: !this.fields.paused });
    addEventListener("keydown", (event) => {
      if (event.key !== " " || event.target !== document.body || byId("replay").hidden) return;
      event.preventDefault();  // the page would scroll
      byId("play").click();
    });
    byId("step").onclick = () => this.#ask({ step: true });
    byId("position").oninput = ({ target }) => this.#move(Number(target.value));
    byId("speed").onchange = ({ target }) => this.#ask({ speed: Number(target.value) });
    byId("loop").onchange = ({ target }) => this.#ask({ loop: target.checked });
  }

  /**
   * Take what a status says; its `replay` is null where nothing is replayed. One that waits for the
   * page goes on once somebody sees its first frame.
   */
  show({ fields: { replay: fields, state }, age_ms, receivedAt }, hello, hasFrame) {
    byId("replay").hidden = !fields;
    if (!fields) return;
    Object.assign(this, { fields, state, shownAt: receivedAt - age_ms });
    for (const control of byId("replay").querySelectorAll("button, input, select")) {
      control.disabled = Boolean(hello?.read_only);
    }
    setText(byId("play"), fields.paused || this.#hasEnded ? "Play" : "Pause replay");
    byId("position").max = fields.duration_s;
    byId("loop").checked = fields.loop;
    const speed = byId("speed");
    if (![...speed.options].some(({ value }) => Number(value) === fields.speed)) {
      speed.append(new Option(fields.speed || "max", fields.speed));
    }
    if (document.activeElement !== speed) speed.value = String(fields.speed);
    const isSeen = hasFrame && document.visibilityState === "visible";
    if (fields.waits_for_page && isSeen && !hello?.read_only) this.#ask({ paused: false });
    this.tick(performance.now());
  }

  /** Show where the replay is by now. */
  tick(now) {
    const { fields } = this;
    if (!fields) return;
    const stands = fields.paused || this.#hasEnded;
    if (stands) this.stoodAt = now;
    const since = stands ? 0 : ((now - this.shownAt) / 1000) * fields.speed;
    const position = Math.min(fields.position_s + since, fields.duration_s);
    const slider = byId("position");
    if (!slider.matches(":active") && this.moves === null) slider.value = position;
    setText(byId("position-text"), `${fixed(Number(slider.value), 1)} / ${fixed(fields.duration_s, 1)} s`);
    slider.ariaValueText = `${fixed(Number(slider.value), 1)} s`;
    this.stood = [...this.stood.filter(({ at }) => at > now - REMEMBERED_MS), { at: now, position_s: position }];
  }

  /** Where the replay was at a moment of performance.now(); undefined where nobody saw. */
  positionAt(moment) {
    return this.stood.findLast(({ at }) => at <= moment)?.position_s;
  }

  /** Pause the replay at a position. */
  standAt(position_s) {
    return this.#ask({ position_s, paused: true });
  }

  /** Whether a frame is of before the last move: replies and frames come by different sockets. */
  isBefore(frame) {
    return this.moves !== null || frame?.sequence <= this.fields?.maps_before;
  }

  // While the daemon moves, the slider may be pulled on: then it moves there next.
  async #move(position_s) {
    const isUnderWay = this.moves !== null;
    this.moves = position_s;
    if (isUnderWay) return;
    for (let asked = null; asked !== this.moves;) {
      asked = this.moves;
      await this.#ask({ position_s: asked });
    }
    this.moves = null;
  }

  get #hasEnded() {
    return this.state === "ended";
  }

  #ask(change) {
    return this.command("replay", change, (fields) => {
      Object.assign(this, { fields, shownAt: performance.now() });
      return "";
    });
  }
}
