// The websocket to the viewer's server: opens it, opens it again, and takes messages apart.

const RETRY_MS = 500;
const SILENT_MS = 4000;  // the server says something every second
const CLOCK_MS = 30_000;  // how often the least delay of messages is found anew

export class Link {
  /**
   * `onFrame(frame)` and `onMessage(message)` are called as they come, with `receivedAt`, when they
   * came by performance.now(), and `waitedMs`, how long the page let them wait; `onChange()` on open
   * and close.
   */
  constructor({ onFrame, onMessage, onChange }) {
    Object.assign(this, { onFrame, onMessage, onChange });
    this.isOpen = false;
    this.lastHeard = performance.now();
    this.waiting = new Map();  // number of a request -> what to do with its reply
    this.requests = 0;
    this.#open();
    setInterval(() => this.#check(), 1000);
    // A page that was left may be kept, asleep, for the way back: it must let go of the skin.
    addEventListener("pagehide", () => this.socket?.close());
  }

  /** Send something without asking for an answer; false when it cannot be sent. */
  send(message) {
    if (!this.isOpen) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  /** Send something and resolve to its reply, {ok, result} or {ok: false, error}. */
  ask(message) {
    return new Promise((resolve) => {
      const request = ++this.requests;
      if (this.send({ ...message, request })) this.waiting.set(request, resolve);
      else resolve(gone());
    });
  }

  #open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/socket`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    this.clock = { since: performance.now(), least: Infinity, before: Infinity };
    socket.onopen = () => {
      this.isOpen = true;
      this.lastHeard = performance.now();
      this.onChange();
    };
    socket.onmessage = ({ data }) => this.#take(data);
    socket.onclose = () => this.#closed(socket);
  }

  #take(data) {
    this.lastHeard = performance.now();
    if (typeof data !== "string") {
      this.send({ type: "confirm" });
      this.onFrame(this.#dated(parseFrame(data)));
      return;
    }
    const message = this.#dated(JSON.parse(data));
    if (message.type !== "reply") {
      this.onMessage(message);
      return;
    }
    this.waiting.get(message.request)?.(message);
    this.waiting.delete(message.request);
  }

  // A busy page lets messages wait: what they take longer than the fastest of late, they waited.
  #dated(message) {
    const now = performance.now();
    const { since, least } = this.clock;
    if (now - since > CLOCK_MS) this.clock = { since: now, least: Infinity, before: least };
    this.clock.least = Math.min(this.clock.least, now - message.sent_ms);
    const receivedAt = message.sent_ms + Math.min(this.clock.least, this.clock.before);
    return { ...message, receivedAt, waitedMs: now - receivedAt };
  }

  #closed(socket) {
    if (socket !== this.socket) return;
    this.socket = null;  // one that was given up for its silence may close once more
    this.isOpen = false;
    for (const resolve of this.waiting.values()) resolve(gone());
    this.waiting.clear();
    this.onChange();
    setTimeout(() => this.#open(), RETRY_MS);
  }

  // A server that hangs, or a computer that left the network, never closes the connection.
  #check() {
    if (this.isOpen && performance.now() - this.lastHeard > SILENT_MS) {
      const { socket } = this;
      this.#closed(socket);
      socket.close();
    }
  }
}

function gone() {
  return { ok: false, error: { cause: "the viewer's server is gone", next_step: "" } };
}

/** Take a binary message apart: its header with `images` by name, each {values, nx, ny}. */
export function parseFrame(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const frame = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  const images = {};
  for (const { name, shape: [ny, nx] } of frame.images) {
    images[name] = { values: new Float32Array(buffer, offset, ny * nx), nx, ny };
    offset += 4 * ny * nx;
  }
  return { ...frame, images };
}
