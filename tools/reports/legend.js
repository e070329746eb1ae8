// What stands around a plot: title, choice, note, and a legend that reads the cursor.

function make(tag, name, text) {
  const node = document.createElement(tag);
  if (name) node.className = name;
  if (text) node.textContent = text;
  return node;
}

function swatch(colour, name) {
  const box = make("i", name);
  box.style.color = `var(--${colour})`;
  return box;
}

// The line over a plot: its title and unit, and which of several it shows.
function topOf(spec, chosen) {
  const top = make("div", "top");
  top.append(make("h3", "", spec.title + (spec.unit ? `, ${spec.unit}` : "")));
  let select = null;
  if (spec.choices) {
    select = make("select");
    select.setAttribute("aria-label", `${spec.title}: which`);
    spec.choices.forEach((choice) => select.append(make("option", "", choice.label)));
    select.addEventListener("change", () => chosen(select.selectedIndex));
    top.append(select);
  }
  if (spec.note) top.append(make("span", "hint", spec.note));
  return [top, select];
}

class Legend {
  constructor(spec, changed) {
    Object.assign(this, { spec, changed, hidden: new Set(), met: new Set(), values: [] });
    this.element = make("div", "legend");
    if (spec.kind === "bars") this.read = make("div", "read");
  }

  fill(lines) {
    this.element.replaceChildren();
    this.lines = lines;
    if (this.spec.kind === "bars") {
      for (const [name, colour] of Object.values(this.spec.codes)) {
        const key = make("span", "key");
        key.append(swatch(colour), name);
        this.element.append(key);
      }
    }
    this.values = lines.map((line) => this.add(line));
  }

  add(line) {
    const button = make("button"), value = make("b");
    if (line.hidden && !this.met.has(line.label)) this.hidden.add(line.label);
    this.met.add(line.label);
    const tell = () => button.setAttribute("aria-pressed", String(!this.hidden.has(line.label)));
    button.type = "button";
    tell();
    button.append(swatch(`c${line.colour % 8}`, line.dashed ? "dashed" : ""), line.label, value);
    button.addEventListener("click", () => {
      if (!this.hidden.delete(line.label)) this.hidden.add(line.label);
      tell();
      this.changed();
    });
    this.element.append(button);
    return value;
  }

  readAt(t, signals) {
    this.lines.forEach((one, index) => {
      const value = t === null ? null : valueAt(signals[one.signal], t);
      this.values[index].textContent = inWords(value);
    });
    if (!this.read) return;
    const parts = t === null ? [] : this.spec.rows.map((row) => {
      const span = row.spans.find(([begin, end]) => begin <= t && t <= end);
      return `${row.label} ${span ? this.spec.codes[span[2]][0] : "silent"}`;
    });
    this.read.textContent = parts.join(" \u00b7 ");
  }
}
