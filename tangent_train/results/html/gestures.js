// Mouse and fingers on the picture: drag, with the right button or two fingers too, pinch, wheel,
// click, double click.

class Gestures {
  constructor(viewer) {
    this.viewer = viewer;
    this.canvas = viewer.canvas;
    this.pressed = new Map(); // fingers, or the mouse, by the browser's number
    this.pointer = null; // where something points, for the readout
    const types = ["pointerdown", "pointermove", "pointerup", "pointercancel", "pointerleave"];
    for (const type of [...types, "click", "dblclick"]) {
      this.canvas.addEventListener(type, (event) => this[type](event));
    }
    this.canvas.addEventListener("contextmenu", (event) => {
      if (viewer.inPoints) event.preventDefault(); // the right button moves the scene
    });
    this.canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  position(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  pointerdown(event) {
    if (event.button !== 0 && !(event.button === 2 && this.viewer.inPoints)) return;
    this.start = this.position(event);
    this.pressed.set(event.pointerId, this.start);
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.classList.add("grabbed");
  }

  pointermove(event) {
    const { view } = this.viewer;
    this.pointer = this.position(event);
    // Released outside, or over a menu.
    if (event.pointerType === "mouse" && event.buttons === 0) this.pointerup(event);
    if (this.pressed.has(event.pointerId)) {
      const [middle, spread] = this.grip();
      this.pressed.set(event.pointerId, this.pointer);
      const [moved, wider] = this.grip();
      const drag = this.pressed.size > 1 || event.buttons === 2 ? "shift" : "pan";
      view[drag](moved[0] - middle[0], moved[1] - middle[1]);
      if (spread > 0 && wider > 0) view.zoom(wider / spread, ...moved);
    }
    this.viewer.redraw();
  }

  // Middle of the fingers, and the distance of two.
  grip() {
    const points = [...this.pressed.values()];
    const mean = (axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length;
    const [a, b] = points;
    const spread = points.length === 2 ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
    return [[mean(0), mean(1)], spread];
  }

  pointerup(event) {
    this.pressed.delete(event.pointerId);
    if (this.pressed.size === 0) this.canvas.classList.remove("grabbed");
  }

  pointercancel(event) {
    this.pointerup(event);
  }

  pointerleave(event) {
    if (event.pointerType !== "mouse") return; // a finger's last place stays readable
    this.pointer = null;
    this.viewer.redraw();
  }

  wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1);
    const factor = Math.exp(-clamp(pixels, -240, 240) / 500);
    this.viewer.view.zoom(factor, ...this.position(event));
    this.viewer.redraw();
  }

  click(event) {
    this.pointer = this.position(event); // a tap does not move
    const [x, y] = this.pointer;
    const isDrag = Math.hypot(x - this.start[0], y - this.start[1]) > 4;
    if (!isDrag) this.viewer.showObject(x, y);
    this.viewer.redraw();
  }

  dblclick(event) {
    this.viewer.view.approach(...this.position(event));
    this.viewer.redraw();
  }
}
