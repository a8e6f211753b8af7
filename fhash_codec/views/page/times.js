// Times as people read them: dates where the coordinate has a calendar that JavaScript knows.

const UNITS = { second: 1e3, minute: 6e4, hour: 36e5, day: 864e5 };
const CALENDARS = ["", "standard", "gregorian", "proleptic_gregorian"];

/** Step and time of a coordinate along t, at a step or between two. */
export function timeText({ values, attributes }, step) {
  const n = Math.min(Math.floor(step), values.length - 1), share = step - n;
  const time = share ? values[n] * (1 - share) + values[n + 1] * share : values[n];
  const shown = Number(step.toFixed(2)), date = dateOf(time, attributes);
  const units = attributes.units && !date ? ` ${attributes.units}` : "";
  return `step ${shown}   ${date ?? `t = ${Number(time.toPrecision(7))}${units}`}`;
}

function dateOf(time, { units, calendar }) {
  const words = /^(second|minute|hour|day)s? since (\d{4})-(\d{1,2})-(\d{1,2})(?:[ T](\d{1,2}):(\d{1,2})(?::(\d{1,2}))?)?/.exec(String(units ?? ""));
  if (!words || !CALENDARS.includes(String(calendar ?? "").toLowerCase())) return null;
  const [, unit, year, month, day, hour = 0, minute = 0, second = 0] = words;
  if (Number(year) < 1583) return null; // before the Gregorian calendar days have other names
  const date = new Date(Date.UTC(year, month - 1, day, hour, minute, second) + time * UNITS[unit]);
  if (Number.isNaN(date.getTime())) return null;
  return date.toISOString().replace("T", " ").replace(/(:00)?(\.\d+)?Z$/, "");
}
