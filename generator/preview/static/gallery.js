// The gallery: which images there are, which of them the filters let through, and the page of them that is shown.
// All that is shown is kept in the address after the #, so that a view can be bookmarked and the browser's back works.
"use strict";

const synthetless = {
  index: { images: [], classes: [] },
  found: [], // keys of the images that the filters let through

  classes: new Map(), // {id, name, colour} by object id

  colour: (id) => synthetless.classes.get(id).colour,
  className: (id) => synthetless.classes.get(id).name,

  // An element with attributes and children; text is always text.
  element(name, attributes = {}, ...children) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children);
    return made;
  },

  state: () => new URLSearchParams(location.hash.slice(1)),

  // The address with some of its settings changed; empty ones are left out.
  address(changes) {
    const state = this.state();
    for (const [key, value] of Object.entries(changes)) {
      if (value === "" || value === null) state.delete(key);
      else state.set(key, value);
    }
    return "#" + state;
  },

  change(changes, remember = false) {
    const address = this.address(changes);
    if (remember) location.hash = address;
    else {
      history.replaceState(null, "", address);
      this.show();
    }
  },

  start() {
    this.classes = new Map(this.index.classes.map((entry) => [entry.id, entry]));
    this.gallery.prepare();
    this.viewer.prepare();
    addEventListener("hashchange", () => this.show());
    this.show();
  },

  show() {
    const key = this.state().get("image");
    this.gallery.filter();
    const known = key !== null && this.index.images.some((image) => image[0] === key);
    document.getElementById("gallery").hidden = known;
    document.getElementById("viewer").hidden = !known;
    if (known) this.viewer.open(key);
    else this.gallery.draw();
  },
};

synthetless.gallery = {
  FIELDS: ["class", "regressor", "visible-min", "visible-max", "margin", "objects-min", "objects-max"],
  PER_INSTANCE: 4, // numbers of an instance in the index: object, regressor, visible thousandths, margin tenths

  prepare() {
    const { index, element } = synthetless;
    this.form = document.getElementById("filters");
    this.tiles = document.getElementById("tiles");
    this.size = document.getElementById("page-size");
    this.legend();
    for (const { id, name } of index.classes) this.form.elements.class.append(element("option", { value: id }, name));
    const largest = index.images.reduce((most, [, flat]) => {
      for (let at = 1; at < flat.length; at += this.PER_INSTANCE) most = Math.max(most, flat[at]);
      return most;
    }, 0);
    for (let i = 0; i <= largest; i++) this.form.elements.regressor.append(element("option", { value: i }, String(i)));
    const changed = () => {
      const values = this.FIELDS.map((name) => [name, this.form.elements[name].value]);
      synthetless.change({ ...Object.fromEntries(values), page: "" });
    };
    this.form.addEventListener("input", changed);
    this.form.addEventListener("reset", () => setTimeout(changed));
    this.form.addEventListener("submit", (event) => event.preventDefault());
    this.size.addEventListener("change", () => synthetless.change({ size: this.size.value, page: "" }));
    document.getElementById("page").addEventListener("change", (event) => this.turn(Number(event.target.value)));
    document.getElementById("page-before").addEventListener("click", () => this.turn(this.page - 1));
    document.getElementById("page-after").addEventListener("click", () => this.turn(this.page + 1));
    document.addEventListener("keydown", (event) => this.key(event));
    const help = document.getElementById("help");
    document.getElementById("help-button").addEventListener("click", () => help.showModal());
  },

  // What the dots mean; a click shows the images with that class.
  legend() {
    const { element, index, colour } = synthetless;
    const entries = index.classes.map(({ id, name }) => {
      const dot = element("span", { class: "dot" });
      dot.style.backgroundColor = colour(id);
      const button = element("button", { type: "button", "data-class": id }, dot, name);
      button.addEventListener("click", () => {
        const chosen = synthetless.state().get("class") === String(id);
        synthetless.change({ class: chosen ? "" : String(id), page: "" });
      });
      return button;
    });
    document.getElementById("classes").open = entries.length <= 12;
    document.querySelector("#classes div").replaceChildren(...entries);
  },

  turn(page) {
    synthetless.change({ page: String(Math.min(Math.max(1, page || 1), this.pages)) });
    scrollTo(0, 0);
  },

  // Keeps the keys of the images in which one instance meets every condition on instances.
  filter() {
    const state = synthetless.state();
    for (const name of this.FIELDS) {
      const field = this.form.elements[name];
      if (field !== document.activeElement) field.value = state.get(name) ?? "";
    }
    for (const button of document.querySelectorAll("#classes button")) {
      button.setAttribute("aria-pressed", String(button.dataset.class === state.get("class")));
    }
    const number = (name, otherwise) => (state.has(name) ? Number(state.get(name)) : otherwise);
    const wanted = { object: number("class", null), regressor: number("regressor", null) };
    const visible = [10 * number("visible-min", 0), 10 * number("visible-max", 100)];
    const margin = 10 * number("margin", Infinity);
    const objects = [number("objects-min", 0), number("objects-max", Infinity)];
    const step = this.PER_INSTANCE;
    const asked = ["class", "regressor", "visible-min", "visible-max", "margin"].some((name) => state.has(name));
    const fits = (flat) => {
      const count = flat.length / step;
      if (count < objects[0] || count > objects[1]) return false;
      if (!asked) return true;
      for (let at = 0; at < flat.length; at += step) {
        if (
          (wanted.object === null || flat[at] === wanted.object) &&
          (wanted.regressor === null || flat[at + 1] === wanted.regressor) &&
          flat[at + 2] >= visible[0] && flat[at + 2] <= visible[1] && flat[at + 3] < margin
        ) return true;
      }
      return false;
    };
    this.images = synthetless.index.images.filter(([, flat]) => fits(flat));
    synthetless.found = this.images.map(([key]) => key);
    this.size.value = state.get("size") ?? "60";
    const size = Number(this.size.value) || 60;
    this.pages = Math.max(1, Math.ceil(this.images.length / size));
    this.page = Math.min(Math.max(1, number("page", 1)), this.pages);
    this.shown = this.images.slice((this.page - 1) * size, this.page * size);
  },

  draw() {
    const total = synthetless.index.images.length;
    document.title = document.querySelector("h1").textContent;
    document.getElementById("found").textContent =
      `${this.images.length.toLocaleString("en")} of ${total.toLocaleString("en")} images`;
    document.getElementById("nothing").hidden = this.images.length > 0;
    document.getElementById("pages").textContent = String(this.pages);
    document.getElementById("page").value = this.page;
    document.getElementById("page").max = this.pages;
    document.getElementById("page-before").disabled = this.page === 1;
    document.getElementById("page-after").disabled = this.page === this.pages;
    this.tiles.replaceChildren(...this.shown.map(([key, flat]) => this.tile(key, flat)));
    const last = this.tiles.querySelector(`[data-key="${synthetless.viewer.last ?? ""}"]`);
    if (last) last.focus();
  },

  tile(key, flat) {
    const { element, colour, className } = synthetless;
    const ids = flat.filter((_, at) => at % this.PER_INSTANCE === 0);
    const names = ids.map((id) => className(id)).join(", ");
    const dots = ids.map((id) => {
      const dot = element("span", { class: "dot", title: className(id) });
      dot.style.backgroundColor = colour(id);
      return dot;
    });
    const picture = element("img", {
      src: `thumbnails/${key}.jpg`, loading: "lazy", decoding: "async", alt: `image ${key}: objects ${names || "none"}`,
    });
    picture.addEventListener("error", () => picture.parentElement.classList.add("undrawn"));
    const caption = element("span", { class: "caption" }, element("span", {}, key), element("span", {}, ...dots));
    const link = element("a", { class: "tile", href: synthetless.address({ image: key }), "data-key": key }, picture, caption);
    return element("div", { role: "listitem" }, link);
  },

  key(event) {
    const help = document.getElementById("help");
    if (event.ctrlKey || event.metaKey || event.altKey || help.open || event.target.matches("input, select")) return;
    if (event.key === "?") help.showModal();
    if (document.getElementById("gallery").hidden) return;
    const links = [...this.tiles.querySelectorAll("a")];
    const at = links.indexOf(document.activeElement);
    const columns = getComputedStyle(this.tiles).gridTemplateColumns.split(" ").length;
    const steps = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -columns, ArrowDown: columns };
    if (event.key in steps && links.length) {
      event.preventDefault();
      links[at < 0 ? 0 : Math.min(Math.max(0, at + steps[event.key]), links.length - 1)].focus();
    }
    if (event.key === "PageDown" || event.key === "PageUp") {
      event.preventDefault();
      this.turn(this.page + (event.key === "PageDown" ? 1 : -1));
    }
  },
};
