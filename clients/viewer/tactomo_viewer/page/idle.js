// A demo that presses itself, until somebody does: two fingers that come, move on and leave.

const LOOP_S = 21;
const MOVE_S = 1.2;  // from one place to the next, where they rest
const STEP_MS = 50;
const REST_MS = 3000;  // that a page is left alone before it begins
// When, where in shares of the sheet's half widths, how hard as a share of the sensor's range.
const FINGERS = [
  [[0.5, -0.45, 0.3, 0.5], [3.5, -0.15, 0.05, 0.57], [7, 0.35, -0.25, 0.5], [11, 0.35, 0.35, 0.58], [15, 0.05, 0.45, 0.5], [18, null]],
  [[5, -0.45, -0.4, 0.5], [9, -0.3, -0.05, 0.57], [13, -0.45, 0.3, 0.3], [17, null]],
];

export class Idle {
  /** `range()` says of the sheet how far it reaches: {x, y} in mm, kpa. */
  constructor({ touch, range }) {
    Object.assign(this, { touch, range });
    this.isOver = false;
    this.since = null;
    const someone = ({ target }) => {
      if (target.closest?.("#map, #press-card, .actions")) this.stop();
    };
    addEventListener("pointerdown", someone, true);
    addEventListener("keydown", someone, true);
    setInterval(() => this.#step(), STEP_MS);
  }

  get isOn() {
    return this.since !== null && performance.now() > this.since;
  }

  /** Begin in a while, if it has not begun. */
  begin() {
    if (!this.isOver) this.since ??= performance.now() + REST_MS;
  }

  /** Let go; `forGood`, because somebody presses. */
  stop(forGood = true) {
    this.isOver ||= forGood;
    this.since = null;
    FINGERS.forEach((_, i) => this.touch.lift(`idle-${i}`));
  }

  #step() {
    if (!this.isOn || document.hidden) return;
    const { x, y, kpa } = this.range();
    const now = ((performance.now() - this.since) / 1000) % LOOP_S;
    FINGERS.forEach((stops, i) => {
      const at = stops.findLastIndex(([from]) => from <= now);
      const [from, ...to] = stops[at] ?? [0, null];
      if (to[0] === null) {
        this.touch.lift(`idle-${i}`);
        return;
      }
      const before = stops[at - 1]?.slice(1) ?? to;
      const t = Math.min(1, (now - from) / MOVE_S);
      const [px, py, share] = to.map((value, k) => before[k] + (value - before[k]) * t * t * (3 - 2 * t));
      this.touch.place(`idle-${i}`, [px * x, py * y], { pressure: share * kpa, size: 30 - 4 * i, shape: "ellipse" });
    });
  }
}
