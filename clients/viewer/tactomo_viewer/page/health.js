// What is wrong, if anything, in words: the banner over the map, and the flags.

import { seconds } from "./values.js";

const STALE_SCANS = 3;        // of a slow sensor: so many scans late
const BRIEFLY_MS = 1500;      // what a page that opens waits for without a word
const SLOW_START_MS = 20_000; // a daemon that builds its models tells nothing meanwhile
const SOON_S = 10;            // after its start a daemon may wait for its ports and for data

// The map is the skin's of now, or of where a replay stands, though a banner is shown.
const CURRENT = ["taring", "ended", "replay-paused", "issue"];

// Flags under which every touch is still seen (clients/STREAM.md); of any other nobody knows.
const TOUCHES_SEEN = ["magnitude_missing", "invalid_voltage", "electrode_fault", "saturated", "channels_skewed", "untaught", "companion_missing", "companion_disputed"];

/** Whether no contacts in a fresh frame means that nothing presses. */
export function areTouchesSeen(frame) {
  return frame.flags.every((flag) => TOUCHES_SEEN.includes(flag));
}

/** The age of a frame or status in ms; the server's part and the time since it came. */
export function ageOf(item, now) {
  return item ? item.age_ms + (now - item.receivedAt) : Infinity;
}

/** Whether the map may be read as what presses now. */
export function isMapCurrent(found) {
  return !found || CURRENT.includes(found.name);
}

/**
 * The banner as {name, level, title, detail}, or null when all is well. What hides everything else
 * comes first. What is under way is an info. `state` has hello, link, frame, status, openedAt,
 * isMoving, stoodAt.
 */
export function verdict(state, now) {
  const { link, frame, status, hello } = state;
  const waited = now - state.openedAt;
  if (!link.isOpen) {
    if (!hello && now < BRIEFLY_MS) return null;
    return banner("viewer-gone", "error", "The viewer's server is gone.",
      "The page tries again; if you stopped the server, start it with `tactomo viewer`.");
  }
  if (!status) {
    if (waited < BRIEFLY_MS) return null;
    if (waited < SLOW_START_MS) {
      return banner("starting", "info", `Waiting for “${hello?.sensor ?? "?"}”.`,
        "A daemon that starts for the first time builds the sensor's models, which takes up to a minute.");
    }
    return banner("no-daemon", "warning", "Waiting for the daemon.",
      `Nothing from sensor “${hello?.sensor ?? "?"}” at ${hello?.stream ?? "?"} yet; is it running under this name? Start it with \`tactomo daemon\`.`);
  }
  if (!isHeard(state, now)) {
    return banner("daemon-gone", "error", "The daemon is gone.",
      `Last heard ${seconds(ageOf(status, now))} ago; the page continues when the daemon is back.`);
  }
  const { fields } = status;
  if (fields.state === "taring") {
    return banner("taring", "info", "Taring.", "Measuring the unloaded skin: do not touch it.");
  }
  const errors = (fields.issues ?? []).filter(({ severity }) => severity === "error");
  const wrong = worst(errors, fields.ports ?? []);
  if (fields.state.startsWith("waiting")) {
    return banner("no-data", fields.uptime_s < SOON_S ? "info" : "warning", "No data yet:", wrong);
  }
  if (fields.ports?.length && fields.ports.every((port) => port.state === "ended")) {
    return banner("ended", "info", "The replay is at its end.", "The map shows its last frame.");
  }
  if (state.isMoving) {
    return banner("replay-moving", "info", "The replay jumps.", "The map follows at once.");
  }
  if (fields.replay?.paused) {
    return banner("replay-paused", "info", "The replay is paused.", "The map shows the frame at the slider"
      + (fields.replay.maps_before ? ", solved without those before: pressures may differ from the recorded ones." : "."));
  }
  if (!frame) {
    if (waited < BRIEFLY_MS) return null;
    return banner("no-frame", waited < 1000 * SOON_S ? "info" : "error", "No frame yet.", wrong);
  }
  const age = Math.min(ageOf(frame, now), now - state.stoodAt);
  const most = staleAfter(fields, hello);
  if (age > most) {
    const since = `The newest frame is ${seconds(age)} old`;
    const sinceTaken = now - frame.receivedAt - frame.waitedMs;  // no more than a slow page takes to draw
    const isSlow = frame.waitedMs > most / 2 && sinceTaken < hello.status_stale_ms;
    const slow = isSlow && "this computer draws the page too slowly";
    return banner("stale", isSlow ? "warning" : "error", "Stale.", [since, slow, wrong].filter(Boolean).join("; "));
  }
  const [issue] = errors;
  return issue ? banner("issue", "warning", `${issue.what}:`, issue.next_step) : null;
}

// What fits into a banner: a port's trouble, which is the cause of what else is told, and how much else.
function worst(errors, ports) {
  if (!errors.length) return "";
  const cause = errors.find(({ what }) => ports.some(({ url }) => what.startsWith(url))) ?? errors[0];
  return cause.what + (errors.length > 1 ? `; ${errors.length - 1} more under Channels` : "");
}

/** Whether the daemon's status comes. */
export function isHeard({ link, status, hello }, now) {
  return link.isOpen && ageOf(status, now) <= (hello?.status_stale_ms ?? 0);
}

function banner(name, level, title, detail) {
  return { name, level, title, detail };
}

/** How old the newest frame may be, in ms, before the page calls it stale. */
export function staleAfter({ ports }, hello) {
  const rates = (ports ?? []).map((port) => port.device?.scan_rate_hz).filter((hz) => hz > 0);
  return Math.max(hello?.frame_stale_ms ?? 0, (STALE_SCANS * 1000) / Math.min(...rates, Infinity));
}
