// The time that all panels share: what is shown, where the cursor is, where it is pinned.

class View {
  constructor(data) {
    [this.begin, this.end] = data.span;
    if (!(this.end > this.begin)) this.end = this.begin + 1;
    Object.assign(this, { from: this.begin, to: this.end, cursor: null, pin: null, drag: null });
    Object.assign(this, { marks: data.marks, panels: [], pending: false, printing: false, look: 0 });
    this.theme = () => "";
  }

  // Where the legends are read: at the cursor, or else where it was pinned.
  get reading() { return this.cursor === null ? this.pin : this.cursor; }

  show(from, to) {
    const least = 0.005, whole = this.end - this.begin;
    const length = Math.min(whole, Math.max(least, to - from));
    const start = Math.min(this.end - length, Math.max(this.begin, (from + to - length) / 2));
    [this.from, this.to] = [start, start + length];
    this.redraw();
  }

  zoom(factor, at) {
    const t = at === undefined || at === null ? (this.from + this.to) / 2 : at;
    this.show(t - (t - this.from) * factor, t + (this.to - t) * factor);
  }

  pan(share) {
    const by = (this.to - this.from) * share;
    this.show(this.from + by, this.to + by);
  }

  all() { this.show(this.begin, this.end); }

  within(t) { return Math.min(this.end, Math.max(this.begin, t)); }

  point(t) {
    this.cursor = t === null ? null : this.within(t);
    if (t !== null && (this.cursor < this.from || this.cursor > this.to)) {
      const half = (this.to - this.from) / 2;
      this.show(this.cursor - half, this.cursor + half);
    }
    this.redraw();
  }

  // Pin the cursor; there once more, or null: take the pin away.
  pinAt(t, near) {
    const again = this.pin !== null && t !== null && Math.abs(t - this.pin) <= (near || 0);
    this.pin = t === null || again ? null : this.within(t);
    this.redraw();
  }

  choose(spec, index) {
    for (const panel of this.panels) {
      if (panel.spec.choices && panel.spec.group === spec.group) panel.choose(index);
    }
    this.redraw();
  }

  readTheme() {
    const style = getComputedStyle(document.documentElement), known = new Map();
    this.theme = (name) => {
      if (!known.has(name)) known.set(name, style.getPropertyValue(name).trim());
      return known.get(name);
    };
    this.look += 1;
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => { this.pending = false; this.draw(false); });
  }

  // Draw the panels that can be seen; all of them for the printer.
  draw(everything) {
    const place = (panel) => panel.canvas.getBoundingClientRect();
    const seen = this.panels.filter((panel) => {
      if (everything) return true;
      const { top, bottom } = place(panel);
      return bottom > -100 && top < window.innerHeight + 100;
    });
    seen.forEach((panel) => panel.draw(this.theme));
    document.getElementById("cursor").textContent = this.inWords();
    for (const [id, value] of [["from", this.from], ["to", this.to]]) {
      const field = document.getElementById(id);
      if (document.activeElement !== field) field.value = value.toFixed(3);
    }
  }

  inWords() {
    const t = this.reading;
    if (t === null) return "";
    const parts = [`t = ${t.toFixed(3)} s`];
    if (this.pin !== null && this.cursor !== null && this.cursor !== this.pin) {
      const by = this.cursor - this.pin;
      parts.push(`\u0394t = ${by < 0 ? "\u2212" : "+"}${Math.abs(by).toFixed(3)} s`);
    }
    const near = (this.to - this.from) / 150;
    const mark = this.marks.find(([at]) => Math.abs(at - t) <= near);
    if (mark) parts.push(mark[2]);
    return parts.join(" \u00b7 ");
  }
}
