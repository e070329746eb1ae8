// Plots beside the robot: a whole record with a line at the time shown, or the last 20 seconds of a
// running robot.
const KEPT_S = 20, EVERY_MS = 200, JUMP_S = 1;
const COLOURS = ["#e0702a", "#2f8fe0", "#2e8a5c", "#b46ae0", "#d98f1f", "#6b7684"];

const PANELS = [
  ["force, N", ["hand, z", "push"], (f) => [f.force[2], Math.hypot(...f.push)]],
  ["COM, mm", ["x", "y"], (f) => [1e3 * f.com[0], 1e3 * f.com[1]]],
  ["height, m", ["torso", "COM", "COM reference"],
    (f) => [f.torso[2], f.com[2], f.planner ? f.planner.height_ref : null]],
  ["torso pitch, rad", ["torso"], (f) => [f.angles[1]]],
  ["age of the oldest command, ms", ["oldest"],
    (f) => [Math.max(...f.ages_ms) >= 0 ? Math.max(...f.ages_ms) : null]],
  ["certificate margin", ["joint services alone", "drives alone"],
    (f) => f.planner ? [f.planner.margin, f.planner.margin_onboard] : [null, null]],
  ["larger joint torque of each module, N m", ["ankle r", "knee r", "hip r", "ankle l", "knee l", "hip l"],
    (f) => [0, 2, 4, 6, 8, 10].map((n) => Math.max(Math.abs(f.tau[n]), Math.abs(f.tau[n + 1])))],
  ["planner tick time, µs", ["tick"], (f) => [f.planner ? f.planner.tick_us : null]],
];

export class Plots {
  constructor(root, course) {
    this.isWhole = course.length > 0;
    this.panels = PANELS.map(([title, names, values]) => {
      const box = document.createElement("div");
      box.className = "panel";
      const heading = document.createElement("h3");
      heading.textContent = title;
      box.append(heading);
      root.append(box);
      const ink = getComputedStyle(document.documentElement);
      const axis = { stroke: ink.getPropertyValue("--faint"), size: 36, font: "11px system-ui",
        grid: { stroke: ink.getPropertyValue("--line") }, ticks: { show: false } };
      const plot = new uPlot({
        width: 100, height: 96, cursor: { show: false }, legend: { show: names.length > 1, live: false },
        scales: { x: { time: false } },
        axes: [{ ...axis, size: 22 }, axis],
        hooks: { draw: [(plot) => this.drawPlace(plot, ink)] },
        series: [{}, ...names.map((label, n) => ({ label, stroke: COLOURS[n], width: 1.5 }))],
      }, [[], ...names.map(() => [])], box);
      return { plot, values, data: [[], ...names.map(() => [])], box };
    });
    for (const frame of course) this.add(frame);
    for (const { plot, data } of this.panels) plot.setData(data);
    new ResizeObserver(() => this.resize(root)).observe(root);
  }

  resize(root) {
    const width = Math.max(120, root.clientWidth - 20);
    for (const { plot } of this.panels) plot.setSize({ width, height: 96 });
  }

  clear() {
    for (const panel of this.panels) panel.data = panel.data.map(() => []);
  }

  add(frame) {
    for (const { values, data } of this.panels)
      [frame.t_s, ...values(frame)].forEach((value, n) => data[n].push(value));
  }

  drawPlace({ ctx, bbox, valToPos }, ink) {
    if (!this.isWhole || this.place_s === undefined) return;
    ctx.fillStyle = ink.getPropertyValue("--ink");
    ctx.fillRect(valToPos(this.place_s, "x", true), bbox.top, devicePixelRatio, bbox.height);
  }

  take(frame) {
    this.place_s = frame.t_s;
    if (!this.isWhole) {
      const last = this.panels[0].data[0].at(-1);
      if (last !== undefined && (frame.t_s < last || frame.t_s > last + JUMP_S)) this.clear();
      this.add(frame);
      for (const { data } of this.panels)
        while (data[0][0] < frame.t_s - KEPT_S) data.forEach((column) => column.shift());
    }
    // redraw after the last frame too, because a record may stop here
    this.due ??= setTimeout(() => {
      this.due = undefined;
      for (const { plot, data } of this.panels) plot.setData(data);
    }, EVERY_MS);
  }
}
