// The time that all panels share: what is shown, where the cursor is, where it is pinned.

class View {
  constructor(data) {
    [this.begin, this.end] = data.span;
    if (!(this.end > this.begin)) this.end = this.begin + 1;
    this.lengthMin = Math.min(this.end - this.begin, Math.max(0.005, 10 * data.grid.step));
    Object.assign(this, { from: this.begin, to: this.end, cursor: null, pin: null });
    Object.assign(this, { marks: data.marks, panels: [], pending: false });
    this.readTheme();
  }

  // The time that the legends and the bar show: at the cursor, or else at the pin.
  get reading() { return this.cursor === null ? this.pin : this.cursor; }

  show(from, to) {
    const length = Math.min(this.end - this.begin, Math.max(this.lengthMin, to - from));
    this.from = Math.min(this.end - length, Math.max(this.begin, (from + to - length) / 2));
    this.to = this.from + length;
    for (const { plot } of this.panels) plot.setSelect(NO_SELECTION, false);
    this.update();
  }

  zoom(factor, at) {
    const t = at === undefined || at === null ? (this.from + this.to) / 2 : at;
    this.show(t - (t - this.from) * factor, t + (this.to - t) * factor);
  }

  pan(fraction) {
    const by = (this.to - this.from) * fraction;
    this.show(this.from + by, this.to + by);
  }

  all() { this.show(this.begin, this.end); }

  within(t) { return Math.min(this.end, Math.max(this.begin, t)); }

  // Draw all panels again: the time shown, the theme, the window or the paper changed.
  update() {
    const t = this.cursor;
    for (const panel of this.panels) panel.update();
    if (t !== null) this.point(t);
    this.describeSoon();
  }

  // Set the cursor of all plots; uPlot takes the time from one plot to the others.
  point(t) {
    if (!this.panels.length) return;
    const inView = t !== null && t >= this.from && t <= this.to, { plot } = this.panels[0];
    plot.setCursor({ left: inView ? plot.valToPos(t, "x") : -10, top: 0 }, true, true);
  }

  // Move the cursor by key; the time shown follows it.
  moveTo(t) {
    const at = this.within(t), half = (this.to - this.from) / 2;
    if (at < this.from || at > this.to) this.show(at - half, at + half);
    this.point(at);
  }

  // uPlot reports the time at the cursor; null: it is in no plot.
  read(t) {
    this.cursor = t;
    this.describeSoon();
  }

  // Pin the cursor. A second pin at the same time, or null, removes the pin.
  pinAt(t, tolerance) {
    const again = this.pin !== null && t !== null && Math.abs(t - this.pin) <= (tolerance || 0);
    this.pin = t === null || again ? null : this.within(t);
    this.panels.forEach((panel) => panel.placePin());
    this.describeSoon();
  }

  choose(spec, index) {
    for (const panel of this.panels) {
      if (panel.spec.choices && panel.spec.group === spec.group) panel.choose(index);
    }
    this.update();
  }

  readTheme() {
    const style = getComputedStyle(document.documentElement), known = new Map();
    this.theme = (name) => {
      if (!known.has(name)) known.set(name, style.getPropertyValue(name).trim());
      return known.get(name);
    };
  }

  describeSoon() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => { this.pending = false; this.describe(); });
  }

  describe() {
    if (this.cursor === null && this.pin !== null) this.point(this.pin);  // legends read the pin
    document.getElementById("cursor").textContent = this.text();
    for (const [id, value] of [["from", this.from], ["to", this.to]]) {
      const field = document.getElementById(id);
      if (document.activeElement !== field) field.value = value.toFixed(3);
    }
  }

  // The time at the cursor, the difference to the pin, and the event there.
  text() {
    const t = this.reading;
    if (t === null) return "";
    const parts = [`t = ${t.toFixed(3)} s`];
    const by = this.pin === null ? 0 : t - this.pin;
    if (Math.abs(by) >= 0.0005) parts.push(`\u0394t = ${by < 0 ? "\u2212" : "+"}${Math.abs(by).toFixed(3)} s`);
    const tolerance = (this.to - this.from) / 150;
    const mark = this.marks.find(([at]) => Math.abs(at - t) <= tolerance);
    if (mark) parts.push(mark[2]);
    return parts.join(" \u00b7 ");
  }
}
