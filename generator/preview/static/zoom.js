// Which part of the drawing is shown: the wheel, two fingers and a double click change it, dragging moves it.
"use strict";

synthetless.zoom = {
  MOST: 32, // times
  fingers: new Map(), // pointers that are down, by id: where they are on the screen

  prepare(drawing) {
    this.drawing = drawing;
    drawing.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    drawing.addEventListener("dblclick", (event) => (this.scale > 1 ? this.fit() : this.by(4, this.place(event))));
    drawing.addEventListener("pointerdown", (event) => {
      drawing.setPointerCapture(event.pointerId);
      this.fingers.set(event.pointerId, event);
    });
    drawing.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      drawing.addEventListener(name, (event) => this.fingers.delete(event.pointerId));
    }
    this.of(1, 1);
  },

  // A drawing of another image: all of it is shown.
  of(width, height) {
    this.size = [width, height];
    this.fit();
  },

  fit() {
    this.scale = 1;
    this.corner = [0, 0];
    this.apply();
  },

  // Larger by a factor, with a point of the image where it is on the screen; the middle if none is named.
  by(factor, place = this.size.map((side, axis) => this.corner[axis] + side / this.scale / 2)) {
    const scale = Math.min(Math.max(this.scale * factor, 1), this.MOST);
    this.corner = place.map((at, axis) => at - (at - this.corner[axis]) * (this.scale / scale));
    this.scale = scale;
    this.apply();
  },

  apply() {
    const sides = this.size.map((side) => side / this.scale);
    this.corner = this.corner.map((at, axis) => Math.min(Math.max(at, 0), this.size[axis] - sides[axis]));
    const [x, y] = this.corner.map((at) => at - 0.5); // pixel (i, j) has its centre at (i, j)
    this.drawing.setAttribute("viewBox", [x, y, ...sides].join(" "));
    this.drawing.style.setProperty("--zoom", this.scale);
    this.drawing.classList.toggle("zoomed", this.scale > 1);
    this.drawing.classList.toggle("pixels", this.scale > 3);
  },

  // Where an event is, in pixels from the image's upper left corner.
  place({ clientX, clientY }) {
    const { x, y } = new DOMPoint(clientX, clientY).matrixTransform(this.drawing.getScreenCTM().inverse());
    return [x + 0.5, y + 0.5];
  },

  wheel(event) {
    const factor = 2 ** (-event.deltaY / (event.deltaMode === 0 ? 250 : 8)); // pixels, or lines
    if (this.scale === 1 && factor <= 1) return; // the page scrolls
    event.preventDefault();
    this.by(factor, this.place(event));
  },

  move(event) {
    if (!this.fingers.has(event.pointerId)) return;
    const before = [...this.fingers.values()].map((each) => this.place(each));
    this.fingers.set(event.pointerId, event);
    const after = [...this.fingers.values()].map((each) => this.place(each));
    const [middle, moved] = [before, after].map((places) => [0, 1].map((axis) => mean(places.map((place) => place[axis]))));
    this.corner = this.corner.map((at, axis) => at + middle[axis] - moved[axis]);
    if (before.length > 1) this.by(apart(after) / Math.max(apart(before), 1e-6), middle);
    else this.apply();
  },
};

function mean(values) {
  return values.reduce((sum, value) => sum + value, 0) / values.length;
}

function apart([[x, y], [x2, y2]]) {
  return Math.hypot(x2 - x, y2 - y);
}
