// Pressing the simulated skin: each finger, the mouse and the space bar is one press, with an id of
// its own. A press that moves is sent again at most once at a time, always with its newest place.

const STEP_MM = { plain: 1, shift: 10 };
const TRAIL = 200;  // places of a press that are remembered

const isSomebodys = (pointer) => typeof pointer === "number" || pointer === "keyboard";

export class Touch {
  /**
   * `view` is what is pressed, see `add`. `indenter()` says with what: {pressure, size, shape};
   * `onPress(press)` hears of new ones.
   */
  constructor({ view, link, indenter, onChange, onPress }) {
    Object.assign(this, { view, link, indenter, onChange, onPress });
    this.enabled = false;
    this.hold = false;
    this.held = [];
    this.down = new Map();  // pointer (or "keyboard") -> press
    this.cursor = null;
    this.count = 0;
    this.canvases = [];
    this.add(view);
    const { canvas } = view;
    canvas.addEventListener("keydown", (event) => this.#keyDown(event));
    canvas.addEventListener("keyup", (event) => {
      if (event.key === " ") this.#release("keyboard", this.hold || event.shiftKey);
    });
    canvas.addEventListener("blur", () => {
      this.cursor = null;
      this.#release("keyboard", false);
      this.onChange();
    });
    document.addEventListener("visibilitychange", () => {
      if (document.hidden) this.#releaseAll();
    });
  }

  /** Press on a view, too: on its canvas, where its `pixelToMm` finds the sheet. */
  add(view) {
    const { canvas } = view;
    this.canvases.push(canvas);
    canvas.classList.toggle("pressable", this.enabled);
    canvas.addEventListener("pointerdown", (event) => this.#pointerDown(event, view));
    canvas.addEventListener("pointermove", (event) => this.#pointerMove(event, view));
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      canvas.addEventListener(name, (event) => this.#release(event.pointerId, this.hold || event.shiftKey));
    }
    canvas.addEventListener("contextmenu", (event) => {
      if (this.down.size) event.preventDefault();  // a long touch is a press, not a menu
    });
  }

  /** All presses of this page, to be drawn. */
  get presses() {
    return [...this.held, ...this.down.values()];
  }

  /** Allow or stop pressing; the presses are forgotten when it stops (the server releases them). */
  enable(enabled) {
    if (enabled === this.enabled) return;
    this.enabled = enabled;
    for (const canvas of this.canvases) canvas.classList.toggle("pressable", enabled);
    Object.assign(this.view.canvas, { role: enabled ? "application" : "img", tabIndex: enabled ? 0 : -1 });
    if (!enabled) {
      this.down.clear();
      this.held = [];
    }
    this.onChange();
  }

  /** Lift everything, the script's and other pages' live presses too. */
  clear() {
    this.down.clear();
    this.held = [];
    this.onChange();
    return this.link.ask({ type: "clear" });
  }

  /** Lift one press that is held. */
  drop(press) {
    press.lifted = true;
    this.held = this.held.filter((held) => held !== press);
    this.link.send({ type: "release", press: press.id });
    this.onChange();
  }

  /** Press by program: `pointer` names what presses, `indenter` is {pressure, size, shape}. */
  place(pointer, point, indenter) {
    if (!this.enabled || !this.view.isOnSheet(...point)) return;
    const press = this.down.get(pointer);
    const rests = press?.x === point[0] && press.y === point[1] && press.pressure === indenter.pressure;
    if (!press) this.#start(pointer, point, indenter);
    else if (!rests) this.#move(Object.assign(press, indenter), point);
  }

  /** Lift what a pointer or a program presses. */
  lift(pointer) {
    this.#release(pointer, false);
  }

  /** Where and how a press was at a moment, of performance.now(); undefined before it was there. */
  static wasAt(press, moment) {
    return press.trail.findLast(({ at }) => at <= moment);
  }

  /** The indenter changed: so do the presses that are down. */
  refresh() {
    for (const [pointer, press] of this.down) {
      if (isSomebodys(pointer)) this.#send(Object.assign(press, this.indenter()));
    }
  }

  #pointerDown(event, view) {
    const point = this.#point(event, view);
    if (!this.enabled || event.button !== 0 || !this.view.isOnSheet(...point)) return;
    event.preventDefault();
    view.canvas.focus({ preventScroll: true, focusVisible: false });
    this.cursor = null;
    view.canvas.setPointerCapture(event.pointerId);
    this.#start(event.pointerId, point);
  }

  #pointerMove(event, view) {
    const press = this.down.get(event.pointerId);
    if (press) this.#move(press, this.#point(event, view));
  }

  #keyDown(event) {
    if (!this.enabled || event.ctrlKey || event.altKey || event.metaKey) return;
    const step = event.shiftKey ? STEP_MM.shift : STEP_MM.plain;
    const by = {
      ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step],
    }[event.key];
    if (by) {
      const [x, y] = this.cursor ?? this.view.middle();
      const next = [x + by[0], y + by[1]];
      if (this.view.isOnSheet(...next)) this.cursor = next;
      const press = this.down.get("keyboard");
      if (press && this.cursor) this.#move(press, this.cursor);
    } else if (event.key === " ") {
      this.cursor ??= this.view.middle();
      if (!this.down.has("keyboard")) this.#start("keyboard", this.cursor);
    } else if (event.key === "Escape") {
      this.#releaseAll();
    } else {
      return;
    }
    event.preventDefault();
    this.onChange();
  }

  #point({ clientX, clientY }, view) {
    const box = view.canvas.getBoundingClientRect();
    return view.pixelToMm(clientX - box.left, clientY - box.top);
  }

  #start(pointer, [x, y], indenter = this.indenter()) {
    const press = { id: String(++this.count), x, y, ...indenter, held: false, trail: [] };
    this.down.set(pointer, press);
    this.#send(press);
    if (isSomebodys(pointer)) this.onPress(press);
    this.onChange();
  }

  #move(press, [x, y]) {
    if (!this.view.isOnSheet(x, y)) return;
    Object.assign(press, { x, y });
    this.#send(press);
    this.onChange();
  }

  #release(pointer, keep) {
    const press = this.down.get(pointer);
    if (!press) return;
    this.down.delete(pointer);
    press.held = keep;
    press.lifted = !keep;
    if (keep) this.held.push(press);
    if (keep) this.#send(press);
    else this.link.send({ type: "release", press: press.id });
    this.onChange();
  }

  #releaseAll() {
    for (const pointer of [...this.down.keys()]) this.#release(pointer, false);
  }

  async #send(press) {
    const { x, y, size, pressure } = press;
    press.trail.push({ at: performance.now(), x, y, size, pressure });
    if (press.trail.length > TRAIL) press.trail.shift();
    press.dirty = true;
    if (press.sending) return;
    press.sending = true;
    while (press.dirty && !press.lifted) {
      press.dirty = false;
      await this.link.ask({
        type: "press",
        press: press.id,
        x_mm: press.x,
        y_mm: press.y,
        pressure_kpa: press.pressure,
        radius_mm: press.size / 2,
        shape: press.shape,
        hold: press.held,
      });
    }
    press.sending = false;
  }
}
