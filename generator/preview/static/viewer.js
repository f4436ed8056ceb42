// One image: its views, what is drawn into it, and what is told beside it. An image's data is a script of its own,
// fetched when it is first looked at, since pages opened from the disk may read nothing but scripts and pictures.
"use strict";

synthetless.arrived = (key, detail) => synthetless.viewer.arrived(key, detail);

synthetless.viewer = {
  OVERLAYS: [
    ["visible", "Visible masks"],
    ["amodal", "Amodal outlines (dashed)"],
    ["true-box", "3D boxes, true pose (white)"],
    ["true-axes", "Axes, true pose (dashed)"],
    ["canonical-box", "3D boxes, canonical pose"],
    ["canonical-axes", "Axes, canonical pose"],
    ["ids", "Object ids"],
    ["regressor", "Regressor index"],
    ["margin", "Margin to the next jump"],
    ["alike", "Other poses that look alike"],
  ],
  KEYS: "123456789a",
  AXES: ["x-axis", "y-axis", "z-axis"],
  WORDS: ["ids", "regressor", "margin"],
  AT_FIRST: "visible canonical-box ids",
  VIEWS: { rgb: ["Image", "i"], depth: ["Depth", "d"], normals: ["Normals", "n"] },
  KEPT: 64, // images whose data stays in memory
  details: new Map(),
  last: null,

  prepare() {
    const { element } = synthetless;
    this.drawing = document.getElementById("drawing");
    synthetless.zoom.prepare(this.drawing);
    const boxes = this.OVERLAYS.map(([name, title], at) => {
      const box = element("input", { type: "checkbox", name, value: name });
      box.addEventListener("change", () => this.toggle(name));
      const axes = name.endsWith("axes") ? ["x", "y", "z"].map((axis) => element("b", { class: `${axis}-axis` }, axis)) : [];
      const words = element("span", {}, title, ...axes);
      return element("label", {}, box, words, element("kbd", { "aria-hidden": "true" }, this.KEYS[at]));
    });
    document.getElementById("overlays").append(...boxes);
    document.getElementById("back").addEventListener("click", () => this.close());
    document.getElementById("before").addEventListener("click", () => this.step(-1));
    document.getElementById("after").addEventListener("click", () => this.step(1));
    document.addEventListener("keydown", (event) => this.key(event));
  },

  overlays: () => new Set((synthetless.state().get("overlays") ?? synthetless.viewer.AT_FIRST).split(" ").filter(Boolean)),

  toggle(name) {
    const chosen = this.overlays();
    if (!chosen.delete(name)) chosen.add(name);
    synthetless.change({ overlays: [...chosen].join(" ") || " " });
  },

  open(key) {
    if (key !== this.current) this.fitted = false;
    this.last = key;
    this.current = key;
    const at = synthetless.found.indexOf(key);
    const count = synthetless.found.length;
    document.title = key;
    document.getElementById("image-name").textContent = key;
    document.getElementById("position").textContent = at < 0 ? "not among the filtered ones" : `${at + 1} of ${count}`;
    document.getElementById("before").disabled = at <= 0;
    document.getElementById("after").disabled = at === count - 1;
    if (this.details.has(key)) this.draw(this.details.get(key));
    else this.fetch(key);
  },

  fetch(key) {
    const script = synthetless.element("script", { src: `data/${key}.js` });
    script.addEventListener("load", () => script.remove());
    script.addEventListener("error", () => {
      script.remove();
      this.drawing.replaceChildren();
      this.tell(`data/${key}.js is missing. While the preview is being made, load this page again later; else make it again.`);
    });
    document.head.append(script);
  },

  arrived(key, detail) {
    if (this.details.size >= this.KEPT) this.details.delete(this.details.keys().next().value);
    this.details.set(key, detail);
    if (key === this.current) this.draw(detail);
  },

  close() {
    synthetless.change({ image: "" }, true);
  },

  step(by) {
    const next = synthetless.found[Math.max(0, synthetless.found.indexOf(this.current)) + by];
    if (next !== undefined) synthetless.change({ image: next });
  },

  tell(words) {
    document.getElementById("legend").textContent = words;
  },

  draw(detail) {
    const names = Object.keys(detail.views);
    const asked = synthetless.state().get("view");
    const view = names.includes(asked) ? asked : names[0];
    this.drawViews(names, view);
    const [width, height] = detail.size;
    if (!this.fitted) synthetless.zoom.of(width, height);
    this.fitted = true;
    this.drawing.style.setProperty("--ratio", width / height);
    this.drawing.style.setProperty("--letters", `${Math.max(width, height) / 42}px`);
    const picture = view && svg("image", { href: detail.views[view], x: -0.5, y: -0.5, width, height });
    if (picture) picture.addEventListener("error", () => this.tell(
      `${decodeURI(detail.views[view])} is missing. These pages show the dataset's own pictures; synthetless preview --copy makes a folder that can be moved.`));
    const chosen = this.overlays();
    for (const box of document.querySelectorAll("#overlays input")) {
      box.checked = chosen.has(box.name);
      if (box.name === "alike") box.parentElement.hidden = !detail.instances.some((instance) => instance.cosets);
    }
    const words = this.WORDS.filter((name) => chosen.has(name));
    const layers = [...this.OVERLAYS.map(([name]) => name).filter((name) => !this.WORDS.includes(name)), "words"];
    const groups = layers
      .filter((name) => (name === "words" ? words.length : chosen.has(name)))
      .map((name) => svg("g", { "data-overlay": name }, ...detail.instances.flatMap((instance) => this.layer(name, instance, words))));
    this.drawing.replaceChildren(...(picture ? [picture] : []), ...groups);
    const legends = {
      depth: () => `Depth: brightest at ${detail.depth_mm[0]} mm, darkest from ${detail.depth_mm[1]} mm on; black where there is none.`,
      normals: () => "Normals in the camera's frame: x red, y green, z blue; mid-grey is zero.",
    };
    this.tell(view in legends ? legends[view]() : "");
    this.drawTable(detail);
    this.drawSections(detail.sections);
  },

  // The shapes of one instance in one layer.
  layer(name, instance, words) {
    const style = `--class: ${synthetless.colour(instance.obj)}`;
    const common = { "data-gt": instance.gt, style };
    if (name === "words") return this.words(instance, words);
    if (name === "visible" || name === "amodal") {
      const d = instance.outlines[name];
      return d ? [svg("path", { ...common, d, class: name })] : [];
    }
    const lines = (of, pose, what) => of[what].map(([x1, y1, x2, y2], at) =>
      svg("line", { ...common, x1, y1, x2, y2, class: [pose, what === "axes" ? this.AXES[at] : "box"].join(" ") }));
    if (name === "alike") return instance.alike.flatMap((ghost) => [...lines(ghost, name, "box"), ...lines(ghost, name, "axes")]);
    const [pose, what] = name.split("-");
    return lines(instance[pose], pose, what);
  },

  words(instance, chosen) {
    if (!instance.place.length) return [];
    const margin = instance.margin >= 180 ? "no jump" : `${instance.margin.toFixed(1)}°`;
    const texts = { ids: synthetless.className(instance.obj), regressor: `r${instance.regressor}`, margin };
    const [x, y] = instance.place;
    const text = svg("text", { x, y, "data-gt": instance.gt });
    text.textContent = chosen.map((name) => texts[name]).join(" · ");
    return [text];
  },

  drawViews(names, view) {
    const buttons = names.map((name) => {
      const pressed = String(name === view);
      const button = synthetless.element("button", { type: "button", "data-view": name, "aria-pressed": pressed }, this.VIEWS[name][0]);
      button.addEventListener("click", () => synthetless.change({ view: name }));
      return button;
    });
    document.getElementById("views").replaceChildren(...buttons);
  },

  drawTable(detail) {
    const { element } = synthetless;
    const judged = detail.instances.some((instance) => instance.cosets);
    document.querySelector("#instances .alike").hidden = !judged;
    const rows = detail.instances.map((instance) => {
      const dot = element("span", { class: "dot" });
      dot.style.backgroundColor = synthetless.colour(instance.obj);
      const [words, colour] = instance.material;
      const swatch = element("span", words ? { class: "swatch", title: words, role: "img", "aria-label": words } : {});
      if (colour) swatch.style.backgroundColor = colour;
      const margin = instance.margin >= 180 ? "none" : `${instance.margin.toFixed(1)}°`;
      const alike = instance.cosets ? `${instance.alike.length + 1} of ${instance.cosets}` : "";
      const cells = [
        `${(100 * instance.visib).toFixed(0)} %`, `${instance.regressor} of ${instance.regressors}`, margin,
        `${instance.distance.toFixed(0)} mm`, swatch, ...(judged ? [alike] : []),
      ];
      const row = element("tr", { tabindex: "0" },
        element("th", { scope: "row" }, dot, synthetless.className(instance.obj)), ...cells.map((cell) => element("td", {}, cell)));
      if (instance.margin < 5) row.classList.add("near-jump");
      for (const [on, off] of [["mouseenter", "mouseleave"], ["focus", "blur"]]) {
        row.addEventListener(on, () => this.single(instance.gt));
        row.addEventListener(off, () => this.single(null));
      }
      return row;
    });
    document.querySelector("#instances tbody").replaceChildren(...rows);
  },

  // Shows one instance alone, or all of them again.
  single(gt) {
    for (const shape of this.drawing.querySelectorAll("[data-gt]")) {
      shape.classList.toggle("dimmed", gt !== null && shape.dataset.gt !== String(gt));
    }
  },

  drawSections(sections) {
    const { element } = synthetless;
    const made = sections.map(({ title, rows }) => {
      const list = element("dl");
      for (const [name, value, colour] of rows) {
        const told = element("dd");
        if (colour) {
          const swatch = element("span", { class: "swatch" });
          swatch.style.backgroundColor = colour;
          told.append(swatch, " ");
        }
        told.append(value);
        list.append(element("dt", {}, name), told);
      }
      return element("section", {}, element("h3", {}, title), list);
    });
    document.getElementById("sections").replaceChildren(...made);
  },

  key(event) {
    if (document.getElementById("viewer").hidden || document.getElementById("help").open) return;
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input[type=number], select")) return;
    const views = Object.entries(this.VIEWS).map(([view, [, letter]]) => [letter, () => synthetless.change({ view })]);
    const toggles = this.OVERLAYS.map(([name], at) => [this.KEYS[at], () => this.toggle(name)]);
    const actions = {
      Escape: () => this.close(),
      ArrowLeft: () => this.step(-1),
      ArrowRight: () => this.step(1),
      0: () => synthetless.change({ overlays: " " }),
      "+": () => synthetless.zoom.by(1.5),
      "-": () => synthetless.zoom.by(1 / 1.5),
      f: () => synthetless.zoom.fit(),
      ...Object.fromEntries([...views, ...toggles]),
    };
    if (event.key in actions) {
      event.preventDefault();
      actions[event.key]();
    }
  },
};

function svg(name, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}
