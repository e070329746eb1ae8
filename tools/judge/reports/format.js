// Numbers and text. The page is in English, so numbers have a decimal point in every locale.

const FONT = "11px system-ui, sans-serif";

function make(tag, name, text) {
  const node = document.createElement(tag);
  if (name) node.className = name;
  if (text) node.textContent = text;
  return node;
}

function withDigits(value, digits) {
  const text = value.toFixed(digits);
  return /^-0\.?0*$/.test(text) ? text.slice(1) : text;
}

// A value to read: four significant digits.
function fourDigits(value) {
  if (value === null || value === undefined) return "";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(2);
  return withDigits(value, size >= 1000 ? 0 : size >= 100 ? 1 : size >= 10 ? 2 : size >= 1 ? 3 : 4);
}

// The numbers of an axis, all with the digits of its step.
function axisTexts(values, step) {
  const digits = (String(step).split(".")[1] || "").length;
  return values.map((value) => withDigits(value, digits));
}
