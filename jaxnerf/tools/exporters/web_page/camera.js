// The camera: it orbits a target, or flies. Poses are 12 numbers by rows, [right, up, back, eye].
"use strict";

const add = (a, b) => a.map((value, i) => value + b[i]);
const times = (a, s) => a.map((value) => value * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));

// Turns a vector around a unit axis (Rodrigues).
function turned(vector, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return add(add(times(vector, c), times(cross(axis, vector), s)), times(axis, dot(axis, vector) * (1 - c)));
}

class OrbitCamera {
  // pose: to begin with; target: what it turns around; up: unit vector; swing: radians, the largest angle from the
  // first direction, in a scene that is seen from one side; null: any.
  constructor(pose, target, up, swing) {
    Object.assign(this, {up, swing});
    this.set(pose, target);
    this.home = this.back;
  }

  set(pose, target) {
    const column = (i) => [pose[i], pose[4 + i], pose[8 + i]];
    [this.right, this.above, this.back, this.eye] = [0, 1, 2, 3].map(column);
    if (target) this.distance = Math.max(dot(add(this.eye, times(target, -1)), this.back), 1e-3);
  }

  get pose() {
    return [0, 1, 2].flatMap((i) => [this.right[i], this.above[i], this.back[i], this.eye[i]]);
  }

  get target() { return add(this.eye, times(this.back, -this.distance)); }

  turn(across, down) {
    const before = [this.right, this.above, this.back], angle = () => Math.acos(Math.min(dot(this.back, this.home), 1));
    const start = angle(), pace = this.swing ? Math.min(2 * this.swing, 1) : 1;  // a drag crosses a small range, too
    [across, down] = [pace * across, pace * down];
    const steep = dot(this.back, this.up);
    const limit = Math.asin(Math.max(-1, Math.min(1, steep))) + down;
    if (Math.abs(limit) > 1.5) down = 0;  // not over the poles
    const way = (vector) => turned(turned(vector, this.right, -down), this.up, -across);
    this.back = unit(way(this.back));
    this.right = unit(turned(this.right, this.up, -across));
    this.above = cross(this.back, this.right);
    if (this.swing && angle() > Math.max(this.swing, start)) [this.right, this.above, this.back] = before;
  }

  orbit(across, down) {
    const target = this.target;
    this.turn(across, down);
    this.eye = add(target, times(this.back, this.distance));
  }

  look(across, down) { this.turn(across, down); }

  move(right, above, back) {
    const scaled = [[this.right, right], [this.above, above], [this.back, back]];
    this.eye = scaled.reduce((eye, [axis, by]) => add(eye, times(axis, by * this.distance)), this.eye);
  }

  zoom(factor) {
    const target = this.target;
    this.distance = Math.max(this.distance * factor, 1e-3);
    this.eye = add(target, times(this.back, this.distance));
  }
}

// Returns the pose between two, at a fraction from 0 to 1.
function between(first, second, fraction) {
  const mixed = first.map((value, i) => value + fraction * (second[i] - value));
  const column = (i) => [mixed[i], mixed[4 + i], mixed[8 + i]];
  const back = unit(column(2)), right = unit(cross(column(1), back)), above = cross(back, right);
  return [0, 1, 2].flatMap((i) => [right[i], above[i], back[i], mixed[4 * i + 3]]);
}
