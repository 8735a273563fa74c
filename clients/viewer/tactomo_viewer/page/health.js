// What is wrong, if anything, in words: the banner over the map, and the flags.

const DAEMON_GONE_MS = 3000;  // a daemon sends its status every second
const STALE_MS = 500;
const STALE_SCANS = 3;        // of a slow sensor: so many scans late

const FLAGS = {
  magnitude_missing: ["Magnitude channel missing", "No scans of the magnitude channel: where it is touched is known, how hard is not."],
  structure_missing: ["Structure channel missing", "No scans of the structure channel: shapes come from the magnitude channel alone."],
  no_reference: ["No reference", "Not tared yet: press Tare while nothing touches the skin."],
  reference_mismatch: ["Reference doubtful", "The reference does not look like this sensor unloaded, or something was on the skin then: tare while nothing touches it. Is it the right sensor, its electrodes in order?"],
  reference_disputed: ["Reference of before", "At the start, or at the tare, something seemed to lie on the skin, or nobody could tell. Take everything off, then tare."],
  no_usable_scan: ["Nothing measured", "No channel has a scan that can be used: that no contact is shown says nothing. Check the cables and leads."],
  misfit_high: ["Misfit high", "The model does not explain the data. Has the reference aged? Tare. Is a wire loose?"],
  not_converged: ["Not converged", "The reconstruction ran out of its time; this map is the best so far."],
  invalid_voltage: ["Invalid voltage", "Some voltages were not numbers, or cannot be right, and were left out. Is a wire loose?"],
  saturated: ["Converter saturated", "The converter clipped; those voltages were left out. Lower the gain or the current."],
  electrode_fault: ["Electrode fault", "An electrode reads nonsense and was left out; the reason beside the method names it. Check its lead and contact, then tare."],
  noise_high: ["Noise high", "Voltages that should be equal differ widely. Look for interference, a loose ground or a broken device."],
  low_confidence: ["Low confidence", "The network expects this map to be wrong. Do not act on it; tare, and check the leads if it stays."],
  channels_swapped: ["Channels swapped?", "The magnitude channel answers more than the structure channel: exchange their plugs, then tare. Or is the structure channel dead?"],
  channels_skewed: ["Channels of two instants", "The two channels' scans of one counter were taken at different times: do not act on this map. Check the sync line between the boards."],
  untaught: ["Not taught", "No press like this one was taught: the physics alone says where it is. Teach more of the skin by `tactomo teach live`."],
};

// Flags under which every touch is still seen (clients/STREAM.md); of any other nobody knows.
const TOUCHES_SEEN = ["magnitude_missing", "invalid_voltage", "electrode_fault", "saturated", "channels_skewed", "untaught"];

/** Whether no contacts in a fresh frame means that nothing presses. */
export function areTouchesSeen(frame) {
  return frame.flags.every((flag) => TOUCHES_SEEN.includes(flag));
}

/** A flag's name and meaning for people. */
export function explainFlag(flag) {
  return FLAGS[flag] ?? [flag.replaceAll("_", " "), ""];
}

/** The age of a frame or status in ms; the server's part and the time since it came. */
export function ageOf(item, now) {
  return item ? item.age_ms + (now - item.receivedAt) : Infinity;
}

/**
 * The banner as {name, level, title, detail}, or null when all is well. What hides everything else
 * comes first. `state` has hello, link, frame, status, openedAt.
 */
export function verdict(state, now) {
  const { link, frame, status, hello } = state;
  if (!link.isOpen) {
    if (!hello && now < 1500) return null;
    return banner("viewer-gone", "error", "The viewer's server is gone.",
      "Trying to reach it again; if it was stopped, start it with `tactomo viewer`.");
  }
  if (!status) {
    if (now - state.openedAt < 1500) return null;
    return banner("no-daemon", "warning", "Waiting for the daemon.",
      `Nothing from sensor “${hello?.sensor ?? "?"}” at ${hello?.stream ?? "?"} yet; is it running under this name? Start it with \`tactomo daemon\`.`);
  }
  const silent = ageOf(status, now);
  if (silent > DAEMON_GONE_MS) {
    return banner("daemon-gone", "error", "The daemon is gone.",
      `Last heard ${seconds(silent)} ago; the page goes on by itself when it is back.`);
  }
  const { fields } = status;
  if (fields.state === "taring") {
    return banner("taring", "info", "Taring.", "Measuring the unloaded skin: do not touch it.");
  }
  if (fields.state.startsWith("waiting")) {
    return banner("no-data", "warning", "No data yet.", portsInWords(fields.ports));
  }
  if (fields.ports?.length && fields.ports.every((port) => port.state === "ended")) {
    return banner("ended", "info", "The replay is at its end.", "The map shows its last frame.");
  }
  if (fields.replay?.paused) {
    return banner("replay-paused", "info", "The replay is paused.", "The map shows the frame at which it stands.");
  }
  if (fields.state === "late") {
    return banner("late", "error", "Frames come late.",
      "Scans come faster than they are reconstructed: choose a faster method, or give the daemon more of the processor.");
  }
  const age = ageOf(frame, now);
  if (age > staleAfter(fields)) {
    const since = frame ? `The newest scan is ${seconds(age)} old. ` : "";
    return banner("stale", "error", "Stale.", since + portsInWords(fields.ports));
  }
  if (frame.flags.includes("no_reference")) {
    return banner("no-reference", "warning", "No reference.", explainFlag("no_reference")[1]);
  }
  return null;
}

function banner(name, level, title, detail) {
  return { name, level, title, detail };
}

/** How old the newest frame may be, in ms, before the page calls it stale. */
export function staleAfter({ ports }) {
  const rates = (ports ?? []).map((port) => port.device?.scan_rate_hz).filter((hz) => hz > 0);
  return Math.max(STALE_MS, (STALE_SCANS * 1000) / Math.min(...rates, Infinity));
}

function portsInWords(ports) {
  const refused = (ports ?? []).find((port) => port.refusal);
  if (refused) return `${refused.url}: the device does not fit the sensor's description: ${refused.refusal}.`;
  const closed = (ports ?? []).filter((port) => !port.connected).map((port) => port.url);
  if (closed.length) return `Not connected: ${closed.join(", ")}.`;
  const troubled = (ports ?? []).find((port) => port.problem);
  if (troubled) return `${troubled.url}: ${troubled.problem}.`;
  return ports?.length ? "The port is open, but no scans come." : "";
}

function seconds(ms) {
  return `${(ms / 1000).toFixed(ms < 9950 ? 1 : 0)} s`;
}
