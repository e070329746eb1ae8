// 3-D view of the robot. Axes as on the robot: x forward, y left, z up. Units: m, rad.
import * as T from "./vendor/three/three.module.min.js";

export const MODE_COLOURS = {
  DISARMED: 0xb3bdc4, HOLD: 0xd98f1f, TRACK: 0x2e8a5c, DAMP: 0x8254b8, FAULT: 0xbf382b,
  SILENT: 0x666666,
};
const METRES_PER_NEWTON = 0.005, SOLES_METRES_PER_NEWTON = 0.0008, FORCE_MIN_N = 2;
const X = new T.Vector3(1, 0, 0), Y = new T.Vector3(0, 1, 0), Z = new T.Vector3(0, 0, 1);

const turn = (axis, angle) => new T.Quaternion().setFromAxisAngle(axis, angle);

// From the foot up, a module rotates by Rx(phi) Ry(theta); from the torso down, by the inverse.
const moduleTurn = (phi, theta) => turn(Y, -theta).multiply(turn(X, -phi));

// Rz(yaw) Rx(roll) Ry(pitch)
const torsoTurn = ([roll, pitch, yaw]) =>
  turn(Z, yaw).multiply(turn(X, roll)).multiply(turn(Y, pitch));

class Arrow extends T.Group {
  constructor(colour, metresPerNewton = METRES_PER_NEWTON) {
    super();
    this.metresPerNewton = metresPerNewton;
    // visible through the torso, inside which the arrow begins
    const paint = new T.MeshBasicMaterial({ color: colour, depthTest: false, transparent: true });
    this.shaft = new T.Mesh(new T.CylinderGeometry(0.012, 0.012, 1, 12), paint);
    this.tip = new T.Mesh(new T.ConeGeometry(0.035, 0.08, 16), paint);
    this.shaft.renderOrder = this.tip.renderOrder = 1;
    this.add(this.shaft, this.tip);
    this.visible = false;
  }

  // Show a force, N, at a position in the parent's frame.
  show(force, place) {
    const vector = new T.Vector3(...force), size = vector.length();
    this.visible = size >= FORCE_MIN_N;
    if (!this.visible) return;
    const length = Math.max(0.02, size * this.metresPerNewton);
    this.position.copy(place);
    this.quaternion.setFromUnitVectors(Y, vector.normalize());
    this.shaft.scale.y = length;
    this.shaft.position.y = length / 2;
    this.tip.position.y = length + 0.04;
  }
}

// Outline and face of a convex polygon with at most `most` corners.
class Polygon extends T.Group {
  constructor(most, colour) {
    super();
    const corners = this.corners = new T.BufferAttribute(new Float32Array(3 * most), 3);
    const outline = new T.BufferGeometry().setAttribute("position", corners);
    const face = new T.BufferGeometry().setAttribute("position", corners);
    face.setIndex(Array.from({ length: most - 2 }, (_, n) => [0, n + 1, n + 2]).flat());
    this.outline = new T.LineLoop(outline, new T.LineBasicMaterial({ color: colour }));
    this.face = new T.Mesh(face, new T.MeshBasicMaterial({
      color: colour, transparent: true, opacity: 0.16, side: T.DoubleSide, depthWrite: false }));
    this.outline.frustumCulled = this.face.frustumCulled = false;
    this.add(this.outline, this.face);
  }

  show(points) {
    points.forEach((point, n) => this.corners.setXYZ(n, point.x, point.y, point.z));
    this.corners.needsUpdate = true;
    this.outline.geometry.setDrawRange(0, points.length);
    this.face.geometry.setDrawRange(0, 3 * (points.length - 2));
  }
}

// Torso and legs as nested groups, so that each rotates by its own joint angles.
class Skeleton extends T.Group {
  constructor(model, paintOf) {
    super();
    this.frames = { torso: new T.Group() };
    this.add(this.frames.torso);
    for (const name of model.modules.slice().sort((a, b) => depth(model, a) - depth(model, b))) {
      const [parent, place] = model.joints[name];
      const frame = this.frames[name] = new T.Group();
      frame.position.set(...place);
      this.frames[parent].add(frame);
    }
    for (const body of model.bodies) {
      const mesh = new T.Mesh(geometryOf(body), paintOf(body));
      mesh.position.set(...body.position);
      if (body.kind === "cylinder") mesh.rotation.x = Math.PI / 2;
      mesh.userData.frame = body.frame;
      this.frames[body.frame].add(mesh);
    }
  }

  pose(model, torso, angles, q) {
    this.frames.torso.position.set(...torso);
    this.frames.torso.quaternion.copy(torsoTurn(angles));
    model.modules.forEach((name, index) =>
      this.frames[name].quaternion.copy(moduleTurn(q[2 * index], q[2 * index + 1])));
  }
}

const depth = (model, name) => {
  const parent = model.joints[name][0];
  return parent === "torso" ? 0 : 1 + depth(model, parent);
};

function geometryOf({ kind, size: [x, y, z] }) {
  if (kind === "cube") return new T.BoxGeometry(x, y, z);
  if (kind === "cylinder") return new T.CylinderGeometry(x / 2, x / 2, z, 20);
  return new T.SphereGeometry(x / 2, 20, 14);
}

export class RobotScene {
  constructor(canvas, model) {
    this.model = model;
    this.canvas = canvas;
    this.renderer = new T.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.world = new T.Scene();
    this.camera = new T.PerspectiveCamera(38, 1, 0.05, 40);
    this.camera.up.set(0, 0, 1);
    this.look = { azimuth: -0.65, elevation: 0.18, distance: 3.3, target: new T.Vector3(0, 0, 0.62) };
    this.world.add(new T.HemisphereLight(0xffffff, 0x556070, 2.2));
    const sun = new T.DirectionalLight(0xffffff, 1.6);
    sun.position.set(2, -3, 5);
    this.world.add(sun);
    const grid = new T.GridHelper(8, 32, 0x7f8a97, 0x7f8a97);
    grid.rotation.x = Math.PI / 2;
    grid.position.z = -model.foot[2] - 0.001;
    grid.material.transparent = true;
    grid.material.opacity = 0.25;
    this.world.add(grid);

    const bone = new T.MeshLambertMaterial({ color: 0x9aa5b0 });
    const torso = new T.MeshLambertMaterial({ color: 0x5b7594, transparent: true, opacity: 0.85 });
    this.robot = new Skeleton(model, (body) => body.frame === "torso" ? torso : bone);
    this.world.add(this.robot);
    this.balls = model.modules.map((name) => {
      const ball = new T.Mesh(new T.SphereGeometry(0.055, 24, 16), new T.MeshLambertMaterial());
      this.robot.frames[name].add(ball);
      return ball;
    });
    const pale = new T.MeshBasicMaterial({
      color: 0x59a5e8, transparent: true, opacity: 0.18, depthWrite: false });
    this.ghost = new Skeleton(model, () => pale);
    this.world.add(this.ghost);

    const blue = 0x2f8fe0;
    this.com = new T.Mesh(new T.SphereGeometry(0.03, 20, 14), new T.MeshLambertMaterial({ color: blue }));
    this.plumb = new T.Line(new T.BufferGeometry().setFromPoints([new T.Vector3(), new T.Vector3()]),
      new T.LineDashedMaterial({ color: blue, dashSize: 0.03, gapSize: 0.02 }));
    this.below = new T.Mesh(new T.RingGeometry(0.012, 0.02, 24),
      new T.MeshBasicMaterial({ color: blue, side: T.DoubleSide }));
    this.capture = new T.Mesh(new T.RingGeometry(0.02, 0.028, 24),
      new T.MeshBasicMaterial({ color: 0xe0702a, side: T.DoubleSide }));
    this.assist = new Arrow(0x2e8a5c);
    this.support = new Polygon(8, MODE_COLOURS.TRACK);
    this.hand = new Arrow(0xe0702a);
    this.push = new Arrow(0xb46ae0);
    this.soles = [0, 1].map(() => new Arrow(0x1f9d9d, SOLES_METRES_PER_NEWTON));
    this.world.add(...this.soles);
    this.robot.frames.torso.add(this.hand, this.assist);
    this.world.add(this.capture);
    this.world.add(this.com, this.plumb, this.below, this.support, this.push);
    this.harness = new T.Vector3(...model.harness);
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  show(frame) {
    const { model } = this;
    this.robot.pose(model, frame.torso, frame.angles, frame.q);
    this.ghost.visible = frame.q_ref.length > 0;
    if (this.ghost.visible) this.ghost.pose(model, frame.torso, frame.angles, frame.q_ref);
    frame.modes.forEach((mode, index) =>
      this.balls[index].material.color.set(MODE_COLOURS[model.modes[mode] ?? "SILENT"]));
    const floor = -model.foot[2];
    this.com.position.set(...frame.com);
    const under = new T.Vector3(frame.com[0], frame.com[1], floor + 0.002);
    this.plumb.geometry.setFromPoints([this.com.position, under]);
    this.plumb.computeLineDistances();
    this.below.position.copy(under);
    this.hand.show(frame.force, this.harness);
    const back = new T.Quaternion().copy(this.robot.frames.torso.quaternion).invert();
    const lift = new T.Vector3(0, 0, frame.planner?.assist_n ?? 0).applyQuaternion(back);
    this.assist.show(lift.toArray(), this.harness);
    this.capture.visible = frame.capture.length > 0;
    this.capture.position.set(frame.capture[0] ?? 0, frame.capture[1] ?? 0, floor + 0.003);
    this.push.show(frame.push, this.robot.frames.torso.position);
    this.soles.forEach((arrow, index) => {
      const [force = [0, 0, 0], cop = [0, 0]] = frame.soles[index] ?? [];
      arrow.show(force, new T.Vector3(cop[0], cop[1], floor));
    });
    this.robot.updateMatrixWorld(true);
    this.support.show(hull(this.corners()));
    this.draw();
  }

  // Return the corners of both soles.
  corners() {
    const [length, width, height] = this.model.foot, found = [];
    for (const name of this.model.modules.filter((each) => each.startsWith("ankle")))
      for (const [x, y] of [[1, 1], [1, -1], [-1, -1], [-1, 1]]) {
        const corner = new T.Vector3(x * length / 2, y * width / 2, -height);
        found.push(corner.applyMatrix4(this.robot.frames[name].matrixWorld));
      }
    return found;
  }

  draw() {
    const { azimuth, elevation, distance, target } = this.look;
    const flat = distance * Math.cos(elevation);
    this.camera.position.set(
      target.x + flat * Math.cos(azimuth), target.y + flat * Math.sin(azimuth),
      target.z + distance * Math.sin(elevation));
    this.camera.lookAt(target);
    this.renderer.render(this.world, this.camera);
  }

  // Return true if the torso is under a position on the canvas, px.
  isTorso(x, y) {
    const { width, height } = this.canvas.getBoundingClientRect();
    const ray = new T.Raycaster();
    ray.setFromCamera(new T.Vector2(2 * x / width - 1, 1 - 2 * y / height), this.camera);
    // only the robot's bodies: an arrow, visible or not, must not block the torso behind it
    const hit = ray.intersectObject(this.robot, true).find(({ object }) => object.userData.frame);
    return hit?.object.userData.frame === "torso";
  }

  // Return metres per pixel at the torso's distance.
  metresPerPixel() {
    const away = this.camera.position.distanceTo(this.robot.frames.torso.position);
    return 2 * away * Math.tan(this.camera.fov * Math.PI / 360) / this.canvas.clientHeight;
  }

  // Return the horizontal world direction that points right in the picture.
  right() {
    return new T.Vector3(-Math.sin(this.look.azimuth), Math.cos(this.look.azimuth), 0);
  }
}

// Convex hull in the floor plane, by Andrew's monotone chain algorithm.
function hull(points) {
  const sorted = points.slice().sort((a, b) => a.x - b.x || a.y - b.y);
  const turnsRight = (a, b, c) => (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x) <= 0;
  const half = (list) => {
    const chain = [];
    for (const point of list) {
      while (chain.length > 1 && turnsRight(chain.at(-2), chain.at(-1), point)) chain.pop();
      chain.push(point);
    }
    return chain.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}
