// Numbers for people: what is known of a contact, with its uncertainty or its bounds.

/** A number to so many decimals with a true minus sign, or a dash when there is none. */
export function fixed(value, decimals) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = value.toFixed(decimals);
  return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");
}

/** The unit by name, and how many decimals its numbers have. */
export const UNITS = { kpa: ["kPa", 0], percent: ["%", 1] };

/**
 * How hard a contact presses, in a unit of UNITS: {value, spread, low, high}. `value` is null where
 * only the bounds are known, from 0 to Infinity where nothing is.
 */
export function pressureOf(contact, unit) {
  if (unit === "percent") {
    const { magnitude, magnitude_sigma: sigma } = contact;
    return quantity(percent(magnitude), percent(sigma));
  }
  const { pressure_kpa: kpa, pressure_sigma_kpa: sigma, pressure_range: range, max_kpa: most } = contact;
  return quantity(kpa, sigma, range === "above", most);
}

/** The force of a contact in newtons, as `pressureOf` has the pressure. */
export function forceOf({ force_n: force, force_sigma_n: sigma, pressure_range: range }) {
  return quantity(force, sigma, range === "above");
}

function quantity(value, spread, isLeast = false, most = null) {
  if (value === null) return { value, spread: null, low: 0, high: most ?? Infinity };
  if (isLeast) return { value: null, spread: null, low: value, high: Infinity };
  return { value, spread, low: Math.max(0, value - (spread ?? 0)), high: value + (spread ?? 0) };
}

/** "173 ± 3", "≥ 173", "≤ 90", or nothing where nothing is known. */
export function quantityText({ value, spread, low, high }, decimals) {
  if (value !== null) {
    return fixed(value, decimals) + (spread === null ? "" : ` ± ${fixed(spread, spread < 1 ? 1 : decimals)}`);
  }
  if (low > 0) return `≥ ${fixed(low, decimals)}`;
  return high < Infinity ? `≤ ${fixed(high, decimals)}` : "";
}

/** The pressure of a contact with its unit; that it is touched where no more is known. */
export function pressureText(contact, unit) {
  const [name, decimals] = UNITS[unit];
  const text = quantityText(pressureOf(contact, unit), decimals);
  return text ? `${text} ${name}` : "touched";
}

export function seconds(ms) {
  return `${fixed(ms / 1000, ms < 9950 ? 1 : 0)} s`;
}

const percent = (share) => (share === null ? null : 100 * share);
