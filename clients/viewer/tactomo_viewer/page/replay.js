// The controls of a replay: they ask the daemon, and show what its status says.

import { byId, fixed, setText } from "./panels.js";

export class Replay {
  /** `command(name, arguments)` asks the daemon, and tells what it refuses. */
  constructor(command) {
    this.command = command;
    this.fields = null;
    byId("play").onclick = () => this.#ask(
      this.#hasEnded ? { position_s: 0, paused: false } : { paused: !this.fields.paused });
    byId("step").onclick = () => this.#ask({ step: true });
    byId("position").onchange = ({ target }) => this.#ask({ position_s: Number(target.value) });
    byId("speed").onchange = ({ target }) => this.#ask({ speed: Number(target.value) });
    byId("loop").onchange = ({ target }) => this.#ask({ loop: target.checked });
  }

  /** Take what a status says; its `replay` is null where nothing is replayed. */
  show({ replay: fields, state }, hello) {
    byId("replay").hidden = !fields;
    if (!fields) return;
    Object.assign(this, { fields, state, shownAt: performance.now() });
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
    if (fields.waits_for_page && !hello?.read_only) this.#ask({ paused: false });
    this.tick(performance.now());
  }

  /** Show where the replay is by now. */
  tick(now) {
    const { fields } = this;
    if (!fields) return;
    const since = fields.paused || this.#hasEnded ? 0 : ((now - this.shownAt) / 1000) * fields.speed;
    const position = Math.min(fields.position_s + since, fields.duration_s);
    const slider = byId("position");
    if (!slider.matches(":active")) slider.value = position;
    setText(byId("position-text"), `${fixed(Number(slider.value), 1)} / ${fixed(fields.duration_s, 1)} s`);
    slider.ariaValueText = `${fixed(Number(slider.value), 1)} s`;
  }

  get #hasEnded() {
    return this.state === "ended";
  }

  #ask(change) {
    this.command("replay", change);
  }
}
