// The panel that shows why a box is where it is: what the policy computed for the legal placements.
"use strict";

const BEST = 6; // placements in the table
const LEAST = 1e-4; // the darkest probability

class WhyPanel {
  /** @param onGhost called with a placement that the user looks at, or null. */
  constructor(onGhost) {
    this.onGhost = onGhost;
    this.parts = Object.fromEntries(
      ["why", "why-summary", "orientations", "map-orientation", "map-shade", "map", "map-note", "best"]
        .map((id) => [id, document.getElementById(id)]),
    );
    this.parts["map-orientation"].addEventListener("change", () => this.drawMap());
    this.parts["map-shade"].addEventListener("change", () => this.drawMap());
    this.parts.map.addEventListener("pointermove", (event) => this.hoverMap(event));
    this.parts.map.addEventListener("pointerleave", () => onGhost(null));
  }

  /** Show the explanation of box i; -1 for none. */
  show(model, i) {
    const why = i < 0 ? null : model.why(i);
    this.parts.why.hidden = !why;
    if (this.model === model && this.i === i) return;
    Object.assign(this, { model, i, why });
    if (!why) return;
    const box = model.boxes[i];
    const listed = why.placements.x.length;
    const ranked = why.values || why.probabilities;
    const kind = model.unit === "mm" ? "candidate" : "placement";
    const words = [why.legal === 1 ? `the only legal ${kind}` : `${plain(why.legal)} legal ${kind}s`];
    if (listed < why.legal) words.push(`${ranked ? "the best " : ""}${plain(listed)} of them are listed`);
    const chosen = why.chosen < 0 ? null : this.placement(why.chosen);
    this.planned = chosen ?? box;
    const away = chosen && Math.max(...["x", "y", "z"].map((axis) => Math.abs(chosen[axis] - box[axis])));
    const unit = Math.max(...model.bins[box.bin]) * 1e-6;
    this.moved = (box.yaw ?? 0) !== 0 || away > unit;
    if (this.moved) words.push("the box was reported at another place than planned; this is about the planned one");
    this.parts["why-summary"].textContent = `${short(model.name(i), 60)}: ${words.join("; ")}.`;
    this.showOrientations(box.orientation);
    this.fillSelects(box.orientation);
    this.showBest();
    this.drawMap();
  }

  showOrientations(chosen) {
    const { orientations } = this.parts;
    orientations.replaceChildren();
    const probabilities = this.why.orientation_probabilities;
    orientations.hidden = !probabilities;
    probabilities?.forEach((probability, o) => {
      const mark = o === chosen ? "chosen" : "";
      const name = element("span", SIDES_IN_ORDER[o], mark);
      const bar = element("div", "", `bar ${mark}`);
      const fill = element("span", "");
      fill.style.width = `${100 * probability}%`;
      bar.append(fill);
      orientations.append(name, bar, element("span", percent(probability, 1), mark));
    });
  }

  fillSelects(chosen) {
    const counts = [0, 0, 0, 0, 0, 0];
    this.why.placements.orientation.forEach((o) => counts[o]++);
    options(
      this.parts["map-orientation"],
      counts.map((count, o) => [o, `${SIDES_IN_ORDER[o]} (${count})`]).filter(([o]) => counts[o]),
      counts[chosen] ? chosen : counts.findIndex((count) => count),
    );
    const shades = [];
    if (this.why.values) shades.push(["values", this.why.value_of || "value"]);
    const cell = this.why.probability_of === "cell" ? " of the cell" : "";
    if (this.why.probabilities) shades.push(["probabilities", `probability${cell}`]);
    const before = this.parts["map-shade"].value;
    const kept = shades.some(([key]) => key === before) ? before : shades[0]?.[0];
    options(this.parts["map-shade"], shades.length ? shades : [["", "legal or not"]], kept ?? "");
  }

  /** The sides of the box along x, y, z in an orientation. */
  sides(orientation) {
    const [w, d, h] = this.model.ownSides(this.model.boxes[this.i]);
    const own = { w, d, h };
    return SIDES_IN_ORDER[orientation].split(" ").map((side) => own[side]);
  }

  placement(m) {
    const { orientation, x, y, z } = this.why.placements;
    const [w, d, h] = this.sides(orientation[m]);
    return { bin: this.model.boxes[this.i].bin, x: x[m], y: y[m], z: z[m], w, d, h };
  }

  /** A table of the best placements by value, or else by probability. */
  showBest() {
    const { values, probabilities, placements, chosen, tries } = this.why;
    const { best } = this.parts;
    const ranks = values ?? probabilities;
    best.hidden = !ranks;
    if (!ranks) return;
    const known = ranks.map((_, m) => m).filter((m) => ranks[m] !== null);
    // A mean of few futures says little, so the placements that were tried most often come first.
    const often = (m) => tries?.[m] ?? 0;
    known.sort((a, b) => often(b) - often(a) || ranks[b] - ranks[a] || (b === chosen) - (a === chosen));
    const rows = known.slice(0, BEST);
    if (chosen >= 0 && !rows.includes(chosen)) rows.push(chosen);
    best.caption.textContent = values ? `Best placements by ${this.why.value_of || "value"}` : "Most probable placements";
    const heads = ["x, y, z", "sides"];
    if (values) heads.push("value");
    if (tries) heads.push("futures");
    if (probabilities) heads.push(this.why.probability_of === "cell" ? "prob. of cell" : "prob.");
    fillTable(best, heads, rows.map((m) => {
      const at = ["x", "y", "z"].map((axis) => this.model.length(placements[axis][m])).join(", ");
      const cells = [at, SIDES_IN_ORDER[placements.orientation[m]]];
      const number = (value) => (value === null ? "–" : plain(value, 4));
      if (values) cells.push(number(values[m]));
      if (tries) cells.push(`${tries[m]}`);
      if (probabilities) cells.push(number(probabilities[m]));
      return { cells, chosen: m === chosen, look: (on) => this.onGhost(on ? this.placement(m) : null) };
    }));
  }

  /** The scale of the map: pixels of a unit, and the corner of the floor. */
  layout() {
    const { map } = this.parts;
    const [width, depth] = this.model.bins[this.model.boxes[this.i].bin];
    const scale = Math.min((map.width - 24) / width, (map.height - 24) / depth);
    const left = (map.width - scale * width) / 2;
    const bottom = (map.height + scale * depth) / 2;
    return { scale, at: (x, y) => [left + scale * x, bottom - scale * y], width, depth };
  }

  listed() {
    const orientation = Number(this.parts["map-orientation"].value);
    const { placements } = this.why;
    return placements.x.map((_, m) => m).filter((m) => placements.orientation[m] === orientation);
  }

  drawMap() {
    const { map } = this.parts;
    const { scale, at, width, depth } = this.layout();
    const pen = map.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    pen.clearRect(0, 0, map.width, map.height);
    const rectangle = (x, y, w, d) => {
      const [left, top] = at(x, y + d);
      return [left, top, scale * w, scale * d];
    };
    pen.fillStyle = colour("--stage");
    pen.fillRect(...rectangle(0, 0, width, depth));
    pen.lineWidth = 2;
    pen.strokeStyle = colour("--line");
    for (const other of this.model.boxes.slice(0, this.i)) {
      if (other.bin !== this.model.boxes[this.i].bin) continue;
      pen.save();
      pen.translate(...at(other.x + other.w / 2, other.y + other.d / 2));
      pen.rotate((-(other.yaw ?? 0) * Math.PI) / 180);
      pen.strokeRect(-scale * other.w / 2, -scale * other.d / 2, scale * other.w, scale * other.d);
      pen.restore();
    }
    pen.strokeStyle = colour("--ink");
    pen.strokeRect(...rectangle(0, 0, width, depth));
    const { placements, chosen } = this.why;
    const shade = this.parts["map-shade"].value;
    const numbers = this.why[shade];
    const rows = this.listed();
    const known = rows.map((m) => numbers?.[m] ?? null).filter((value) => value !== null);
    const [low, high] = [Math.min(...known), Math.max(...known)];
    // Probabilities differ by powers of ten, so each power has the same step of the scale.
    const share = (value) => {
      if (shade === "probabilities") return 1 + Math.log10(Math.max(value, LEAST)) / -Math.log10(LEAST);
      return high > low ? (value - low) / (high - low) : 1;
    };
    const cells = this.model.unit === "cells";
    const side = cells ? Math.max(5, scale) : 11;
    const rank = (m) => numbers?.[m] ?? -Infinity;
    for (const m of [...rows].sort((a, b) => rank(a) - rank(b))) {
      const value = numbers?.[m] ?? null;
      const [x, y] = at(placements.x[m], placements.y[m]);
      pen.fillStyle = value === null ? this.model.doc.unknown : this.model.scaleColour(share(value));
      pen.fillRect(...(cells ? [x + 1, y - side + 1, side - 2, side - 2] : [x - 5, y - 5, side, side]));
    }
    const { planned } = this;
    if (Number(this.parts["map-orientation"].value) === this.model.boxes[this.i].orientation || chosen < 0) {
      pen.strokeStyle = colour("--bad");
      pen.lineWidth = 4;
      pen.strokeRect(...rectangle(planned.x, planned.y, planned.w, planned.d));
    }
    const dark = shade === "probabilities" ? `${LEAST} or less (each power of ten is a step)` : plain(low, 4);
    const bright = shade === "probabilities" ? 1 : plain(high, 4);
    const grey = known.length < rows.length ? "; grey: not computed" : "";
    const range = known.length ? ` Dark: ${dark}, bright: ${bright}${grey}.` : "";
    const text = `Seen from above: where the low corner of the box may lie. Red: the ${this.moved ? "planned " : ""}box. Lines: the boxes that were there.${range}`;
    this.parts["map-note"].textContent = text;
    map.setAttribute("aria-label", `${rows.length} legal placements from above. ${text}`);
  }

  hoverMap(event) {
    if (!this.why) return;
    const { at } = this.layout();
    const area = this.parts.map.getBoundingClientRect();
    const x = ((event.clientX - area.left) * this.parts.map.width) / area.width;
    const y = ((event.clientY - area.top) * this.parts.map.height) / area.height;
    const { placements } = this.why;
    const middle = this.model.unit === "cells" ? 0.5 : 0;
    let [nearest, distance] = [-1, 25];
    for (const m of this.listed()) {
      const [left, top] = at(placements.x[m] + middle, placements.y[m] + middle);
      const away = Math.hypot(left - x, top - y);
      if (away < distance) [nearest, distance] = [m, away];
    }
    this.onGhost(nearest < 0 ? null : this.placement(nearest));
  }
}

/** A new element with a text and a class. */
function element(tag, text, name = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (name.trim()) made.className = name.trim();
  return made;
}

/** Fill a <select> with pairs of value and label. */
function options(select, pairs, chosen) {
  select.replaceChildren(...pairs.map(([value, label]) => new Option(label, value, false, String(value) === String(chosen))));
}

/**
 * Fill a table.
 * @param rows objects with `cells`; `chosen` marks a row; `look(on)` makes its first cell a button that is called
 * while the row has the pointer or the focus; `press` is called when it is pressed; `faint` dims the row.
 * @param sort called with the head of the column to sort by; @param sorting the column and the direction now.
 */
function fillTable(table, heads, rows, sort = null, sorting = null) {
  const head = document.createElement("tr");
  head.append(...heads.map((text) => {
    const cell = element("th", sort ? "" : text);
    cell.scope = "col";
    if (sort) {
      const button = element("button", text);
      button.type = "button";
      button.addEventListener("click", () => sort(text));
      if (text === sorting.column) cell.setAttribute("aria-sort", sorting.down ? "descending" : "ascending");
      cell.append(button);
    }
    return cell;
  }));
  table.tHead.replaceChildren(head);
  table.tBodies[0].replaceChildren(...rows.map(({ cells, chosen, faint, look, press }) => {
    const row = document.createElement("tr");
    row.className = chosen ? "chosen" : faint ? "faint" : "";
    cells.forEach((text, k) => {
      const cell = document.createElement("td");
      if (k === 0 && (look || press)) {
        const button = element("button", text);
        button.type = "button";
        if (look) {
          button.addEventListener("focus", () => look(true));
          button.addEventListener("blur", () => look(false));
        }
        if (press) button.addEventListener("click", press);
        cell.append(button);
      } else cell.textContent = text;
      row.append(cell);
    });
    if (look) {
      row.addEventListener("pointerenter", () => look(true));
      row.addEventListener("pointerleave", () => look(false));
    }
    return row;
  }));
}
