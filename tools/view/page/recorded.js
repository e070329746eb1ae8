// A run stored in the page itself, which replaces the connection to the server.
const EVERY_MS = 1000 / 30;

export async function recordedRun() {
  const packed = document.getElementById("run");
  if (!packed) return undefined;
  const bytes = Uint8Array.from(atob(packed.textContent.trim()), (letter) => letter.charCodeAt(0));
  const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new RecordedRun(await new Response(unpacked).json());
}

// Implements the part of the WebSocket interface that the page uses.
class RecordedRun {
  constructor({ model, frames, every_s }) {
    model.course = frames.filter(Boolean);
    Object.assign(this, { model, frames, every_s, readyState: WebSocket.OPEN });
    this.place_s = Math.max(model.begin_s, Math.min(0, model.end_s));
    this.rate = 1;
    this.playing = false;
    setTimeout(() => {
      this.onopen?.();
      this.tell({ model });
      this.last_ms = performance.now();
      setInterval(() => this.advance(), EVERY_MS);
    });
  }

  send(text) {
    const { play, seek_s, rate } = JSON.parse(text), { begin_s, end_s } = this.model;
    if (seek_s !== undefined) this.place_s = Math.min(Math.max(seek_s, begin_s), end_s);
    if (rate !== undefined) this.rate = rate;
    if (play && this.place_s >= end_s) this.place_s = begin_s;
    if (play !== undefined) this.playing = play;
    this.sent = undefined;
  }

  advance() {
    const now_ms = performance.now(), { end_s } = this.model;
    if (this.playing) this.place_s += (now_ms - this.last_ms) / 1000 * this.rate;
    this.last_ms = now_ms;
    if (this.place_s >= end_s) Object.assign(this, { place_s: end_s, playing: false });
    if (this.sent === this.place_s && this.told === this.playing) return;
    const last = this.frames.length - 1;
    const number = Math.min(last, Math.max(0, Math.round((this.place_s - this.model.begin_s) / this.every_s)));
    const frame = this.frames[number];
    this.tell({ frame: frame && { ...frame, t_s: this.place_s }, playing: this.playing });
    Object.assign(this, { sent: this.place_s, told: this.playing });
  }

  tell(message) {
    this.onmessage?.({ data: JSON.stringify(message) });
  }
}
