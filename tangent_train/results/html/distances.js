// Distances: their meaning, and their points as a scene to turn. Axes: ahead, right, up.

class Distances {
  constructor(scale, sphere, colors) {
    Object.assign(this, scale, { sphere, colors });
    this.noun = sphere || !scale.camera ? "distance" : "z-depth";
    this.logs = [scale.near, scale.far, ...scale.limits].map(Math.log);
  }

  get hasPoints() {
    return Boolean(this.sphere || this.camera);
  }

  // Logarithm of the distance of a pixel; null if it is unknown. The shader does the same.
  log(red, green) {
    const value = 256 * red + green;
    const [near, far] = this.logs;
    return value ? near + ((value - 1) / 65534) * (far - near) : null;
  }

  color(log) {
    const [, , first, last] = this.logs;
    return this.colors[Math.round(255 * clamp((log - first) / (last - first), 0, 1))];
  }

  number(distance) {
    const digits = { minimumSignificantDigits: 3, maximumSignificantDigits: 3 };
    return distance.toLocaleString("en", digits);
  }

  text(distance) {
    return `${this.number(distance)} ${this.unit === "m" ? "m" : `(${this.unit})`}`;
  }
}

class Scene {
  constructor() {
    this.canvas = [1, 1];
  }

  show({ center, radius }, sphere) {
    Object.assign(this, { center, radius, start: sphere ? [30, -30] : [20, -20] });
    this.reset();
  }

  reset() {
    this.target = [...this.center];
    [this.longitude, this.latitude] = this.start;
    this.away = this.fitting;
  }

  resize(width, height) {
    const fitted = this.away === this.fitting;
    this.canvas = [Math.max(width, 1), Math.max(height, 1)];
    if (fitted) this.away = this.fitting;
  }

  get half() {
    return Math.max(...this.canvas) / 2;
  }

  // What half the longer side of the canvas reaches at distance 1 from the eye.
  get reach() {
    return Math.tan(25 * DEGREE);
  }

  // Distance of the eye at which the scene fits.
  get fitting() {
    const reach = (this.reach * Math.min(...this.canvas)) / 2 / this.half;
    return (0.95 * this.radius) / Math.sin(Math.atan(reach));
  }

  get axes() {
    const [lon, lat] = [this.longitude * DEGREE, this.latitude * DEGREE];
    const [c, s] = [Math.cos(lon), Math.sin(lon)];
    return {
      ahead: [Math.cos(lat) * c, Math.cos(lat) * s, Math.sin(lat)],
      right: [-s, c, 0],
      up: [-Math.sin(lat) * c, -Math.sin(lat) * s, Math.cos(lat)],
    };
  }

  get eye() {
    const { ahead } = this.axes;
    return this.target.map((value, k) => value - this.away * ahead[k]);
  }

  // Turn around the middle: the front follows the pointer.
  pan(dx, dy) {
    const degrees = 90 / this.half;
    this.longitude = (this.longitude + dx * degrees) % 360;
    this.latitude = clamp(this.latitude - dy * degrees, -90, 90);
  }

  // Move the scene: its middle follows the pointer.
  shift(dx, dy) {
    const { right, up } = this.axes;
    const step = (this.away * this.reach) / this.half;
    this.target = this.target.map((value, k) => value - step * (dx * right[k] - dy * up[k]));
  }

  zoom(factor) {
    this.away = clamp(this.away / factor, 0.02 * this.radius, 20 * this.radius);
  }

  approach() {
    this.reset();
  }
}
