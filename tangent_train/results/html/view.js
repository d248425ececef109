// Where the viewer looks: projections between the canvas and the image, turning and zooming.
// Positions in an image are u to the right and v down, 0 to 1. Panoramas: longitude = (u − ½)·360°,
// growing to the right, latitude = (½ − v)·180°, up. The shader does the same sums.

const DEGREE = Math.PI / 180;
const clamp = (value, least, most) => Math.min(most, Math.max(least, value));
const fraction = (value) => value - Math.floor(value);

// Extents: the angle seen along the longer side of the canvas in degrees; for a flat image the share
// of its width.
const PROJECTIONS = {
  inside: { index: 0, start: 95, least: 5, most: 130 },
  planet: { index: 1, start: 250, least: 60, most: 330 },
  flat: { index: 2 },
};
const FLAT_ZOOM = 64;

class View {
  constructor() {
    this.canvas = [1, 1];
    this.image = { sphere: true, aspect: 2 };
    this.projection = "inside";
    this.reset();
  }

  show(image) {
    const same = image.sphere === this.image.sphere;
    this.image = image;
    if (!image.sphere) this.projection = "flat";
    else if (!same) this.projection = "inside";
    if (!same || !image.sphere) this.reset();
  }

  project(projection) {
    const fromPlanet = this.projection === "planet";
    this.projection = projection;
    this.extent = this.limits.start;
    if (projection === "planet") this.v = 1;
    else if (fromPlanet) this.v = 0.5;
    this.keepInside();
  }

  reset() {
    this.u = 0.5;
    this.v = this.projection === "planet" ? 1 : 0.5;
    this.extent = this.limits.start;
  }

  resize(width, height) {
    const fitted = this.projection === "flat" && this.extent >= 0.999 * this.limits.most;
    this.canvas = [Math.max(width, 1), Math.max(height, 1)];
    if (fitted) this.extent = this.limits.most;
    this.keepInside();
  }

  get half() {
    return Math.max(...this.canvas) / 2;
  }

  get limits() {
    if (this.projection !== "flat") return PROJECTIONS[this.projection];
    const [width, height] = this.canvas;
    const whole = 2 * Math.max(this.half / width, this.half / (height * this.image.aspect));
    return { start: whole, least: whole / FLAT_ZOOM, most: whole };
  }

  // What half the longer side of the canvas reaches on the plane of the projection.
  get reach() {
    if (this.projection === "flat") return this.extent / 2;
    if (this.projection === "planet") return 2 * Math.tan((this.extent * DEGREE) / 4);
    return Math.tan((this.extent * DEGREE) / 2);
  }

  get longitude() {
    return (this.u - 0.5) * 360;
  }

  get latitude() {
    return (0.5 - this.v) * 180;
  }

  // Pixel of the canvas (from the top left) to {u, v}; null where there is no image.
  locate(x, y) {
    const [px, py] = this.onPlane(x, y);
    if (this.projection !== "flat") return this.alongRay(px, py);
    const u = this.u + px;
    const v = this.v - py * this.image.aspect;
    const { sphere } = this.image;
    const once = sphere ? Math.abs(px) <= 0.5 : u >= 0 && u <= 1;
    return once && v >= 0 && v <= 1 ? { u: sphere ? fraction(u) : u, v } : null;
  }

  onPlane(x, y) {
    const scale = this.reach / this.half;
    return [(x - this.canvas[0] / 2) * scale, (this.canvas[1] / 2 - y) * scale];
  }

  alongRay(px, py) {
    const [lon, lat] = [this.longitude * DEGREE, this.latitude * DEGREE];
    const ahead = this.projection === "planet" ? 1 - (px * px + py * py) / 4 : 1;
    const level = ahead * Math.cos(lat) - py * Math.sin(lat);
    const d = [
      level * Math.cos(lon) - px * Math.sin(lon),
      level * Math.sin(lon) + px * Math.cos(lon),
      ahead * Math.sin(lat) + py * Math.cos(lat),
    ];
    const v = 0.5 - Math.atan2(d[2], Math.hypot(d[0], d[1])) / Math.PI;
    return { u: fraction(Math.atan2(d[1], d[0]) / (2 * Math.PI) + 0.5), v };
  }

  // Move what is shown by pixels of the canvas: what lies in the middle follows exactly.
  pan(dx, dy) {
    const step = this.reach / this.half;
    if (this.projection === "flat") {
      this.u -= dx * step;
      this.v -= dy * step * this.image.aspect;
    } else {
      const shrink = Math.max(Math.cos(this.latitude * DEGREE), 0.25);
      this.u -= (dx * step) / shrink / (2 * Math.PI);
      this.v -= (dy * step) / Math.PI;
    }
    this.keepInside();
  }

  shift(dx, dy) {
    this.pan(dx, dy);
  }

  approach(x, y) {
    const at = this.locate(x, y);
    if (!at) return;
    if (this.projection !== "flat") Object.assign(this, at);
    this.zoom(2, x, y);
  }

  // Zoom in by a factor; on flat images the point at (x, y) stays where it is.
  zoom(factor, x = this.canvas[0] / 2, y = this.canvas[1] / 2) {
    const before = this.onPlane(x, y);
    this.extent = clamp(this.extent / factor, this.limits.least, this.limits.most);
    const after = this.onPlane(x, y);
    if (this.projection === "flat") {
      this.u += before[0] - after[0];
      this.v -= (before[1] - after[1]) * this.image.aspect;
    }
    this.keepInside();
  }

  keepInside() {
    this.extent = clamp(this.extent, this.limits.least, this.limits.most);
    const flat = this.projection === "flat";
    const share = (side) => (flat ? Math.min((this.extent * side) / (4 * this.half), 0.5) : 0);
    const [across, down] = [share(this.canvas[0]), share(this.canvas[1] * this.image.aspect)];
    this.u = this.image.sphere ? fraction(this.u) : clamp(this.u, across, 1 - across);
    this.v = clamp(this.v, down, 1 - down);
  }
}
