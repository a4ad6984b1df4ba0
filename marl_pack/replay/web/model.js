// The plan, and what follows from it at each step. Step t: the first t boxes are placed.
"use strict";

const SIDES_IN_ORDER = ["w d h", "d w h", "w h d", "h w d", "d h w", "h d w"];

/** A number with at most `digits` decimals, without zeros at the end. */
function plain(value, digits = 2) {
  return Number(value.toFixed(digits)).toLocaleString("en", { maximumFractionDigits: digits });
}

/** A text with at most so many characters. */
function short(text, most) {
  return text.length <= most ? text : `${text.slice(0, most - 1)}…`;
}

function percent(share, digits = 0) {
  return `${(100 * share).toFixed(digits)} %`;
}

class Model {
  /** @param doc the document that marl_pack.replay.document makes. */
  constructor(doc) {
    this.doc = doc;
    this.boxes = doc.boxes;
    this.bins = doc.bins;
    this.unit = doc.unit;
    this.orders = doc.orders ?? [];
    this.restsOn = this.boxes.map((box) => box.rests_on);
    this.carries = this.boxes.map(() => []);
    this.restsOn.forEach((below, i) => below.forEach((j) => this.carries[j].push(i)));
    this.orderNames = [...new Set(this.orders)];
    const longest = Math.max(...this.bins.flat());
    this.digits = Math.min(20, Math.max(1, 4 - Math.floor(Math.log10(longest))));
  }

  get last() {
    return this.boxes.length;
  }

  /** The ways to colour boxes that this plan has values for. */
  get colourings() {
    return Object.keys(this.doc.colours);
  }

  colour(i, colouring) {
    return this.doc.colours[colouring].boxes[i];
  }

  /** The colour at a share from 0 to 1 of the scale, as "#rrggbb". */
  scaleColour(share) {
    const { scale } = this.doc;
    return scale[Math.round(Math.min(1, Math.max(0, share)) * (scale.length - 1))];
  }

  name(i) {
    return this.boxes[i].id || `#${i + 1}`;
  }

  /** The weight that rests on box i at a step, directly or through others. */
  load(i, step) {
    const above = new Set();
    const open = [i];
    while (open.length) {
      for (const j of this.carries[open.pop()]) {
        if (j < step && !above.has(j)) {
          above.add(j);
          open.push(j);
        }
      }
    }
    return [...above].reduce((sum, j) => sum + this.boxes[j].weight, 0);
  }

  /** What each bin holds at a step. */
  binsAt(step) {
    const rows = this.bins.map(([w, d, h]) => ({ boxes: 0, volume: w * d * h, filled: 0, weight: 0, top: 0 }));
    for (const box of this.boxes.slice(0, step)) {
      const row = rows[box.bin];
      row.boxes += 1;
      row.filled += box.w * box.d * box.h;
      row.weight += box.weight;
      row.top = Math.max(row.top, box.z + box.h);
    }
    return rows.map((row) => ({ ...row, utilization: row.filled / row.volume }));
  }

  /** The bin of the box placed last at a step. */
  openBin(step) {
    return step ? this.boxes[step - 1].bin : 0;
  }

  caption(step) {
    const bin = this.openBin(step);
    const words = [`Box ${step} of ${this.last}`];
    if (this.bins.length > 1) words.push(`bin ${bin}`);
    words.push(`${percent(this.binsAt(step)[bin].utilization)} filled`);
    return words.join(" · ");
  }

  /** The own sides of a box before it was rotated; as placed where the orientation is unknown. */
  ownSides(box) {
    const placed = [box.w, box.d, box.h];
    if (box.orientation < 0) return placed;
    const order = SIDES_IN_ORDER[box.orientation].split(" ");
    return ["w", "d", "h"].map((side) => placed[order.indexOf(side)]);
  }

  /** A length with digits that suit the size of the bins. */
  length(value) {
    return plain(value, this.digits);
  }

  /** The values of a box at a step: rows of key, label, text and whether it is bad. */
  values(i, step) {
    const box = this.boxes[i];
    const rows = [
      ["id", "Id", short(box.id || "–", 200)],
      ["size", "Size", `${[box.w, box.d, box.h].map((v) => this.length(v)).join(" × ")} ${this.unit}`],
      ["position", "Position", `${[box.x, box.y, box.z].map((v) => this.length(v)).join(", ")} ${this.unit}`],
    ];
    if (this.bins.length > 1) rows.push(["bin", "Bin", `${box.bin}`]);
    if (this.orderNames.length > 1) rows.push(["order", "Order", short(this.orders[box.bin], 200)]);
    if (box.orientation >= 0) rows.push(["orientation", "Orientation", `${SIDES_IN_ORDER[box.orientation]}`]);
    if (box.yaw) rows.push(["yaw", "Yaw", `${plain(box.yaw)}°`]);
    rows.push(["support", "Support", percent(box.support, 1)]);
    if (box.margin !== undefined) rows.push(["margin", "Margin", `${this.length(box.margin)} ${this.unit}`, box.margin < 0]);
    const kilograms = this.doc.unit_mm === null ? "" : " kg";
    rows.push(["weight", "Weight", `${plain(box.weight)}${kilograms}${box.weight_assumed ? " (assumed)" : ""}`]);
    const load = this.load(i, step);
    const limit = box.max_load === undefined ? "" : ` of ${plain(box.max_load)}${kilograms}`;
    rows.push(["load", "Load above", `${plain(load)}${kilograms}${limit}`, box.max_load !== undefined && load > box.max_load * 1.000001]);
    if (box.stackable === false) rows.push(["stackable", "Stackable", "no"]);
    return rows;
  }

  /** Why box i is where it is; null where the plan does not say. */
  why(i) {
    return this.doc.explanations?.[i] ?? null;
  }
}
