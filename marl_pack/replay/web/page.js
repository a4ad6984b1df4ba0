// The page: its controls, and what they change.
"use strict";

const STEP_MS = 900;
const LIVE_MS = 1000;
const UPCOMING = 14; // boxes on the conveyor that are drawn
const NAMED = 12; // colours in the legend
const $ = (id) => document.getElementById(id);

class Page {
  constructor(doc) {
    this.step = 0;
    this.selected = -1;
    this.hovered = -1;
    this.sorting = { column: "box", down: false };
    this.why = new WhyPanel((placement) => this.view?.showGhost(placement));
    this.load(doc);
    this.step = this.model.last;
    this.readAddress();
    this.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    this.openView();
    this.listen();
    this.show();
    const live = document.documentElement.dataset.live;
    if (live) this.follow(live);
  }

  /** Show a document that has changed; who looks at the last step follows it. */
  update(doc, drop) {
    const atEnd = this.step === this.model.last && !this.playing;
    const same = (i) => i >= 0 && JSON.stringify(doc.boxes[i]) === JSON.stringify(this.model.boxes[i]);
    if (!same(this.selected)) this.selected = -1;
    this.load(doc);
    this.view?.setModel(this.model);
    this.setTheme(document.documentElement.dataset.theme);
    this.goTo(atEnd ? this.model.last : this.step, drop && atEnd);
  }

  /** Take a new document. */
  load(doc) {
    this.model = new Model(doc);
    document.title = doc.title || "Replay";
    $("title").textContent = short(doc.title || "Replay", 120);
    $("slider").max = this.model.last;
    const [colour, bin] = [$("colour").value, $("bin").value];
    const colourings = this.model.colourings;
    options($("colour"), colourings.map((name) => [name, name]), colourings.includes(colour) ? colour : "item");
    const bins = this.model.bins.map((_, k) => [k, [k, ...(this.model.orders[k] ? [short(this.model.orders[k], 40)] : [])].join(": ")]);
    const many = bins.length > 1;
    options($("bin"), many ? [["open", "open one"], ["all", "all"], ...bins] : [["all", "all"]], many ? bin || "open" : "all");
    if ($("bin").selectedIndex < 0) $("bin").selectedIndex = 0;
    $("bin-label").hidden = !many;
    const left = doc.left_out ?? [];
    $("left-out").hidden = !left.length;
    $("left-out").querySelector("ul").replaceChildren(...left.map((box) =>
      element("li", `${short(box.id || "box", 60)} (${[box.w, box.d, box.h].map((v) => this.model.length(v)).join(" × ")}): ${box.reason}`)));
  }

  /** Fill the table of all boxes, if it is open. A press on a column's head sorts by it. */
  showBoxes() {
    if (!$("all").open) return;
    const { model, step } = this;
    const kilograms = model.doc.unit_mm === null ? "" : ", kg";
    const columns = [
      ["box", (box, i) => i, (box, i) => `${i + 1} ${short(box.id, 40)}`],
      ["size", (box) => box.w * box.d * box.h, (box) => [box.w, box.d, box.h].map((v) => model.length(v)).join(" × ")],
      ["position", (box) => box.z, (box) => [box.x, box.y, box.z].map((v) => model.length(v)).join(", ")],
      ["bin", (box) => box.bin, (box) => `${box.bin}`],
      ["support", (box) => box.support, (box) => percent(box.support)],
      ["margin", (box) => box.margin ?? Infinity, (box) => (box.margin === undefined ? "–" : model.length(box.margin))],
      [`weight${kilograms}`, (box) => box.weight, (box) => plain(box.weight)],
      [`load${kilograms}`, (box, i) => loads[i], (box, i) => plain(loads[i])],
    ].filter(([name]) => (name !== "bin" || model.bins.length > 1) && (name !== "margin" || model.doc.colours.margin));
    const loads = model.boxes.map((_, i) => model.load(i, step));
    const { column, down } = this.sorting;
    const key = (columns.find(([name]) => name === column) ?? columns[0])[1];
    const order = model.boxes.map((_, i) => i).sort((a, b) => {
      const [left, right] = [key(model.boxes[a], a), key(model.boxes[b], b)];
      return (down ? -1 : 1) * (left < right ? -1 : left > right ? 1 : 0) || a - b;
    });
    const focused = [...$("boxes").querySelectorAll("button")].indexOf(document.activeElement);
    fillTable($("boxes"), columns.map(([name]) => name), order.map((i) => ({
      cells: columns.map(([, , write]) => write(model.boxes[i], i)),
      faint: i >= step,
      press: () => {
        this.goTo(Math.max(this.step, i + 1));
        this.select(i);
      },
    })), (name) => {
      this.sorting = { column: name, down: name === column ? !down : false };
      this.showBoxes();
    }, this.sorting);
    if (focused >= 0) $("boxes").querySelectorAll("button")[focused]?.focus();
  }

  openView() {
    try {
      this.view = new View3D($("view"), this.model);
      this.setTheme(document.documentElement.dataset.theme);
    } catch (error) {
      console.warn(error);
      $("no-webgl").hidden = false;
      $("view").hidden = true;
    }
  }

  /** Go to a step; a step outside the plan becomes the nearest one. */
  goTo(step, drop = false) {
    this.step = Math.min(this.model.last, Math.max(0, Math.round(step) || 0));
    if (this.selected >= this.step) this.selected = -1;
    if (this.hovered >= this.step) this.hovered = -1;
    this.show(drop);
  }

  /** The bin that is shown: a number, or null for all. */
  get bin() {
    const { value } = $("bin");
    if (value === "open") return this.model.openBin(this.step);
    return value === "all" ? (this.model.bins.length === 1 ? 0 : null) : Number(value);
  }

  /** The box whose values are shown: under the pointer, selected, or placed last. */
  get subject() {
    if (this.hovered >= 0) return this.hovered;
    return this.selected >= 0 ? this.selected : this.step - 1;
  }

  show(drop = false) {
    const { model, step } = this;
    this.view?.showGhost(null);
    $("slider").value = step;
    $("slider").setAttribute("aria-valuetext", model.caption(step));
    $("caption").textContent = model.caption(step);
    $("view").setAttribute("aria-label", `Bins in 3D. ${model.caption(step)}`);
    for (const id of ["first", "back"]) $(id).disabled = step === 0;
    for (const id of ["forward", "last"]) $(id).disabled = step === model.last;
    if (this.view) {
      const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
      this.view.setBin(this.bin);
      this.view.show(step, $("colour").value, this.subject, drop && !calm);
    }
    this.showLegend();
    this.showConveyor();
    const rows = model.binsAt(step);
    const kilograms = model.doc.unit_mm === null ? "weight" : "kg";
    fillTable($("bins"), ["bin", "boxes", "filled", "top", kilograms], rows.map((row, k) => ({
      cells: [
        model.orders[k] ? `${k} (${short(model.orders[k], 40)})` : `${k}`, `${row.boxes}`,
        percent(row.utilization, 1), model.length(row.top), plain(row.weight, 1),
      ],
      chosen: rows.length > 1 && k === model.openBin(step),
    })));
    this.showSubject();
    this.showBoxes();
    const seen = this.view?.visible.includes(this.hovered);
    if (this.hovered >= 0 && seen) this.fillTooltip();
    else this.hover(-1);
    this.keepAddress();
  }

  /** Write what is shown into the address once the user rests: browsers limit how often this may be done. */
  keepAddress() {
    clearTimeout(this.addressTimer);
    this.addressTimer = setTimeout(() => {
      const shown = { step: this.step, colour: $("colour").value, bin: $("bin").value };
      try {
        history.replaceState(null, "", `#${new URLSearchParams(shown)}`);
      } catch (error) {
        console.warn(error); // a page inside another one has no address
      }
    }, 400);
  }

  /** Show what the address asks for; nonsense in it changes nothing. */
  readAddress() {
    const asked = new URLSearchParams(location.hash.slice(1));
    for (const id of ["colour", "bin"]) {
      const known = [...$(id).options].some((option) => option.value === asked.get(id));
      if (known) $(id).value = asked.get(id);
    }
    if (asked.has("step") && Number.isFinite(Number(asked.get("step")))) this.step = Number(asked.get("step"));
    this.goTo(this.step);
  }

  showSubject() {
    const i = this.subject;
    $("box-heading").textContent = i < 0 ? "Box" : `Box ${i + 1}${i === this.step - 1 ? ", placed last" : ""}`;
    $("box").replaceChildren(...(i < 0 ? [element("dd", "No box is placed yet.")] : valueList(this.model.values(i, this.step))));
    this.view?.mark(i);
    this.why.show(this.model, i);
  }

  select(i) {
    this.selected = i < this.step ? i : -1;
    const { bin } = this;
    if (this.selected >= 0 && bin !== null && this.model.boxes[i].bin !== bin) {
      $("bin").value = this.model.boxes[i].bin;
      this.show();
    } else this.showSubject();
  }

  showLegend() {
    const { model } = this;
    const colouring = $("colour").value;
    const legend = $("legend");
    legend.replaceChildren();
    const { names, range } = model.doc.colours[colouring];
    names.slice(0, NAMED).forEach((name, k) => {
      const swatch = element("span", "", "swatch");
      swatch.style.background = model.doc.palette[k % model.doc.palette.length];
      legend.append(swatch, `${short(name, 40)} `);
    });
    if (names.length > NAMED) legend.append(` + ${names.length - NAMED} more`);
    if (range) {
      const unit = colouring === "margin" ? ` ${model.unit}` : model.doc.unit_mm === null ? "" : " kg";
      const scale = element("span", "", "scale");
      scale.style.background = `linear-gradient(90deg, ${model.doc.scale.join(", ")})`;
      const digits = colouring === "margin" ? model.digits : 2;
      legend.append(`${colouring} ${plain(range[0], digits)} `, scale, ` ${plain(range[1], digits)}${unit}`);
    }
  }

  showConveyor() {
    const coming = this.model.boxes.slice(this.step, this.step + UPCOMING);
    const longest = Math.max(...this.model.boxes.map((box) => Math.max(box.w, box.d, box.h)), 1e-9);
    const strip = $("conveyor");
    strip.replaceChildren(...coming.map((box, k) => {
      const figure = element("figure", "", k === 0 ? "next" : "");
      const sides = this.model.ownSides(box);
      figure.append(boxPicture(sides, longest, this.model.colour(this.step + k, $("colour").value)));
      figure.append(element("figcaption", short(box.id, 14) || sides.map((v) => this.model.length(v)).join("×")));
      figure.title = `${short(box.id, 200)} ${sides.map((v) => this.model.length(v)).join(" × ")} ${this.model.unit}`;
      return figure;
    }));
    const rest = this.model.last - this.step - coming.length;
    if (rest > 0) strip.append(element("p", `+ ${rest} more`));
    const live = document.documentElement.dataset.live && !this.model.doc.closed;
    if (!coming.length) strip.append(element("p", live ? "No box is waiting." : "No more boxes."));
  }

  setTheme(theme) {
    document.documentElement.dataset.theme = theme;
    const style = getComputedStyle(document.documentElement);
    const names = ["stage", "floor", "wire", "ink", "accent"];
    this.view?.setColours(Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()])));
    this.why.i = undefined; // its map has other colours now
    this.why.show(this.model, this.subject);
  }

  toggleTheme() {
    this.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  }

  get playing() {
    return this.timer !== undefined;
  }

  togglePlay(on = !this.playing) {
    clearTimeout(this.timer);
    this.timer = undefined;
    if (on) {
      if (this.step === this.model.last) this.goTo(0);
      const tick = () => {
        this.goTo(this.step + 1, true);
        if (this.step === this.model.last) this.togglePlay(false);
        else this.timer = setTimeout(tick, STEP_MS / Number($("speed").value));
      };
      this.timer = setTimeout(tick, STEP_MS / Number($("speed").value));
    }
    $("play-word").textContent = on ? "Pause" : "Play";
    $("play").classList.toggle("playing", on);
  }

  /** Choose the next option of a <select>. */
  next(select) {
    select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
    this.show();
  }

  listen() {
    const stepTo = (step, drop) => {
      this.togglePlay(false);
      this.goTo(step, drop);
    };
    $("first").addEventListener("click", () => stepTo(0));
    $("back").addEventListener("click", () => stepTo(this.step - 1));
    $("play").addEventListener("click", () => this.togglePlay());
    $("forward").addEventListener("click", () => stepTo(this.step + 1, true));
    $("last").addEventListener("click", () => stepTo(this.model.last));
    $("slider").addEventListener("input", () => stepTo(Number($("slider").value)));
    for (const id of ["colour", "bin"]) $(id).addEventListener("change", () => this.show());
    $("reset").addEventListener("click", () => this.view?.reset());
    $("all").addEventListener("toggle", () => this.showBoxes());
    window.addEventListener("hashchange", () => this.readAddress());
    $("theme").addEventListener("click", () => this.toggleTheme());
    $("help").addEventListener("click", () => $("keys").showModal());
    const keys = {
      " ": () => this.togglePlay(),
      ArrowLeft: () => stepTo(this.step - 1), ArrowRight: () => stepTo(this.step + 1, true),
      Home: () => stepTo(0), End: () => stepTo(this.model.last),
      "+": () => this.view?.zoom(1.2), "=": () => this.view?.zoom(1.2), "-": () => this.view?.zoom(1 / 1.2),
      a: () => this.view?.turn(0.15, 0), d: () => this.view?.turn(-0.15, 0),
      w: () => this.view?.turn(0, 0.12), s: () => this.view?.turn(0, -0.12),
      r: () => this.view?.reset(), c: () => this.next($("colour")), b: () => this.next($("bin")),
      t: () => this.toggleTheme(), "?": () => $("keys").showModal(), Escape: () => this.select(-1),
    };
    document.addEventListener("keydown", (event) => {
      // Keys that move a control, or scroll what has the focus, keep their meaning there.
      const inside = event.target.closest("input, select, button, summary, dialog, aside, #conveyor");
      const own = inside && (event.key.length > 1 || event.key === " " || inside.matches("select, dialog"));
      if (event.ctrlKey || event.metaKey || event.altKey || (own && event.key !== "Escape") || $("keys").open) return;
      if (!Object.hasOwn(keys, event.key)) return;
      event.preventDefault();
      keys[event.key]();
    });
    this.listenToPointer();
  }

  listenToPointer() {
    const view = $("view");
    let pressed = null;
    view.addEventListener("pointerdown", (event) => (pressed = [event.clientX, event.clientY]));
    view.addEventListener("pointermove", (event) => {
      if (event.buttons || !this.view) return;
      this.hover(this.view.pick(event.offsetX, event.offsetY), event.offsetX, event.offsetY);
    });
    view.addEventListener("pointerleave", () => this.hover(-1));
    view.addEventListener("click", (event) => {
      const still = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 5;
      if (still && this.view) this.select(this.view.pick(event.offsetX, event.offsetY));
    });
  }

  hover(i, x = 0, y = 0) {
    const tooltip = $("tooltip");
    tooltip.hidden = i < 0;
    if (i >= 0) {
      if (i !== this.hovered) this.fillTooltip(i);
      const stage = $("stage").getBoundingClientRect();
      tooltip.style.left = `${Math.max(4, Math.min(x + 14, stage.width - tooltip.offsetWidth - 4))}px`;
      tooltip.style.top = `${Math.max(4, Math.min(y + 14, stage.height - tooltip.offsetHeight - 4))}px`;
    }
    if (i === this.hovered) return;
    this.hovered = i;
    this.showSubject();
  }

  fillTooltip(i = this.hovered) {
    const list = document.createElement("dl");
    list.append(...valueList(this.model.values(i, this.step)));
    $("tooltip").replaceChildren(list);
  }

  /** Ask again and again for a plan that still grows. */
  async follow(url) {
    $("live").hidden = false;
    let before = "";
    for (;;) {
      try {
        const answer = await fetch(url, { cache: "no-store" });
        if (!answer.ok) throw new Error(`status ${answer.status}`);
        const text = await answer.text();
        $("live").textContent = "live";
        $("live").classList.remove("lost");
        if (text !== before) {
          const grown = before !== "";
          before = text;
          this.update(JSON.parse(text), grown);
          if (this.model.doc.closed) {
            $("live").textContent = "closed";
            return;
          }
        }
      } catch (error) {
        console.warn(error);
        $("live").textContent = "connection lost";
        $("live").classList.add("lost");
      }
      await new Promise((resolve) => setTimeout(resolve, LIVE_MS));
    }
  }
}

/** The elements of a list of values. */
function valueList(rows) {
  return rows.flatMap(([key, label, text, bad]) => {
    const value = element("dd", text, bad ? "bad" : "");
    value.dataset.key = key;
    return [element("dt", label), value];
  });
}

/** A picture of a box of given sides, as SVG. */
function boxPicture([w, d, h], longest, colour) {
  const scale = 30 / longest;
  const [right, back] = [[0.9, 0.35], [0.55, -0.42]];
  const point = (x, y, z) => [x * w * right[0] + y * d * back[0], x * w * right[1] + y * d * back[1] - z * h];
  const faces = [
    [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], 0.82], [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1], 0.65],
    [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], 1],
  ];
  const all = CORNERS.map((corner) => point(...corner));
  const [left, top] = [0, 1].map((k) => Math.min(...all.map((p) => p[k])));
  const size = [0, 1].map((k) => scale * (Math.max(...all.map((p) => p[k])) - [left, top][k]) + 2);
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("width", size[0]);
  svg.setAttribute("height", size[1]);
  svg.setAttribute("aria-hidden", "true");
  for (const [a, b, c, e, light] of faces) {
    const shape = document.createElementNS("http://www.w3.org/2000/svg", "polygon");
    const points = [a, b, c, e].map((corner) => point(...corner).map((v, k) => (scale * (v - [left, top][k]) + 1).toFixed(1)));
    shape.setAttribute("points", points.map((p) => p.join(",")).join(" "));
    shape.setAttribute("fill", shaded(colour, light));
    shape.setAttribute("stroke", "#20242a");
    shape.setAttribute("stroke-width", "0.6");
    svg.append(shape);
  }
  return svg;
}

/** A colour "#rrggbb" made darker. */
function shaded(colour, light) {
  const parts = [1, 3, 5].map((k) => Math.round(parseInt(colour.slice(k, k + 2), 16) * light));
  return `rgb(${parts.join(" ")})`;
}

window.page = new Page(JSON.parse($("document").textContent));
