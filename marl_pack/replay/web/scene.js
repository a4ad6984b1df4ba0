// The bins in 3D. Lengths of the plan are divided so that the longest side of a bin is 10.
"use strict";

const DROP_MS = 260;
const MARGIN = 1.14; // how much larger the picture is than the bins
const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [k & 1, (k >> 1) & 1, (k >> 2) & 1]);
const EDGES = CORNERS.flatMap((a, i) =>
  CORNERS.slice(i + 1).filter((b) => b.reduce((sum, v, k) => sum + Math.abs(v - a[k]), 0) === 1).map((b) => [a, b]),
);

class View3D {
  /** @param canvas where to draw; throws if the browser has no WebGL. */
  constructor(canvas, model) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.1, 1000);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.requestDraw());
    this.controls.addEventListener("start", () => (this.moved = true));
    this.raycaster = new THREE.Raycaster();
    const sun = new THREE.DirectionalLight(0xffffff, 1.9);
    sun.position.set(0.35, -1, 1.6);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a8f98, 1.7), sun);
    this.setModel(model);
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
    this.reset();
  }

  /** Take things out of the scene and free their memory. */
  discard(...parts) {
    for (const part of parts.filter(Boolean)) {
      this.scene.remove(part);
      part.geometry?.dispose();
      part.material.map?.dispose();
      part.material.dispose();
      part.dispose?.();
    }
  }

  /** Show another plan; the view stays if the bins are the same. */
  setModel(model) {
    this.moved &&= JSON.stringify(model.bins) === JSON.stringify(this.model.bins);
    this.discard(this.mesh, this.edges, this.outline, this.ghost, this.frames, ...(this.labels ?? []));
    [this.frames, this.labels] = [null, []];
    this.model = model;
    const count = Math.max(1, model.last);
    this.unit = Math.max(...model.bins.flat()) / 10;
    const faces = new THREE.MeshLambertMaterial({ polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
    this.mesh = new THREE.InstancedMesh(new THREE.BoxGeometry(1, 1, 1), faces, count);
    this.mesh.frustumCulled = false;
    this.mesh.count = 0;
    this.edges = this.lines(count, 1);
    this.outline = this.lines(1, 1);
    this.outline.material.depthTest = false;
    this.outline.renderOrder = 2;
    this.ghost = this.lines(1, 1);
    this.ghost.material.depthTest = false;
    this.ghost.renderOrder = 3;
    this.scene.add(this.mesh, this.edges, this.outline, this.ghost);
    this.visible = [];
    this.bin = undefined;
  }

  lines(count, opacity) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(count * 72), 3));
    geometry.setDrawRange(0, 0);
    const lines = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ transparent: opacity < 1, opacity }));
    lines.frustumCulled = false;
    return lines;
  }

  /** The low corner of a bin in the scene. */
  origin(bin) {
    if (this.bin !== null || this.model.bins.length === 1) return [0, 0];
    const columns = Math.ceil(Math.sqrt(this.model.bins.length));
    const across = 1.3 * Math.max(...this.model.bins.map((size) => size[0])) / this.unit;
    const deep = 1.5 * Math.max(...this.model.bins.map((size) => size[1])) / this.unit;
    return [(bin % columns) * across, -Math.floor(bin / columns) * deep];
  }

  /** Show one bin, or all with null. */
  setBin(bin) {
    if (this.bin === bin) return;
    if (this.bin !== undefined) this.moved = false; // other bins are elsewhere
    this.bin = bin;
    this.shown = this.model.bins.map((_, k) => k).filter((k) => bin === null || k === bin);
    this.discard(this.frames, ...this.labels);
    this.frames = this.lines(this.shown.length, 1);
    this.labels = [];
    this.shown.forEach((k, row) => {
      const [w, d, h] = this.model.bins[k].map((side) => side / this.unit);
      const [x, y] = this.origin(k);
      this.writeEdges(this.frames, row, [x, y, 0], [w, d, h], 0);
      const floor = new THREE.Mesh(new THREE.PlaneGeometry(w, d), new THREE.MeshBasicMaterial({ color: this.colours?.floor }));
      floor.position.set(x + w / 2, y + d / 2, -0.01);
      floor.name = "floor";
      this.labels.push(floor);
      const texts = this.shown.length > 1
        ? [[`${k}`, [x + w / 2, y - 0.8, 0]]]
        : ["x", "y", "z"].map((axis, a) => {
            const at = [[w / 2, -0.7, 0], [w + 0.8, d / 2, 0], [-0.5, -0.3, h / 2]][a];
            return [`${axis} ${this.model.length(this.model.bins[k][a])}`, at];
          });
      for (const [text, at] of texts) this.labels.push(this.label(text, at));
    });
    this.frames.geometry.setDrawRange(0, 24 * this.shown.length);
    this.scene.add(this.frames, ...this.labels);
    this.setColours(this.colours);
    if (!this.moved) this.reset();
  }

  label(text, at) {
    const canvas = document.createElement("canvas");
    canvas.width = 256;
    canvas.height = 64;
    const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map: new THREE.CanvasTexture(canvas), depthTest: false }));
    sprite.position.set(...at);
    sprite.scale.set(3.2, 0.8, 1);
    sprite.userData = { text, canvas };
    return sprite;
  }

  /** @param colours stage, floor, wire, ink and accent. */
  setColours(colours) {
    if (!colours) return;
    this.colours = colours;
    this.scene.background = new THREE.Color(colours.stage);
    this.frames?.material.color.set(colours.wire);
    this.edges.material.color.set("#20242a");
    this.outline.material.color.set(colours.ink);
    this.ghost.material.color.set(colours.accent);
    for (const label of this.labels ?? []) {
      if (label.name === "floor") {
        label.material.color.set(colours.floor);
        continue;
      }
      const { canvas, text } = label.userData;
      const pen = canvas.getContext("2d");
      pen.clearRect(0, 0, 256, 64);
      pen.font = "34px system-ui, 'DejaVu Sans', sans-serif";
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillStyle = colours.ink;
      pen.fillText(text, 128, 32);
      label.material.map.needsUpdate = true;
    }
    this.requestDraw();
  }

  /** Write the 12 edges of a box as line `row`. */
  writeEdges(lines, row, low, sides, yaw) {
    const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
    const array = lines.geometry.attributes.position.array;
    const middle = [low[0] + sides[0] / 2, low[1] + sides[1] / 2];
    let at = 72 * row;
    for (const edge of EDGES) {
      for (const corner of edge) {
        const x = (corner[0] - 0.5) * sides[0];
        const y = (corner[1] - 0.5) * sides[1];
        array[at++] = middle[0] + cos * x - sin * y;
        array[at++] = middle[1] + sin * x + cos * y;
        array[at++] = low[2] + corner[2] * sides[2];
      }
    }
    lines.geometry.attributes.position.needsUpdate = true;
  }

  place(box, lift = 0) {
    const [x, y] = this.origin(box.bin);
    const low = [x + box.x / this.unit, y + box.y / this.unit, box.z / this.unit + lift];
    return { low, sides: [box.w, box.d, box.h].map((side) => side / this.unit), yaw: ((box.yaw ?? 0) * Math.PI) / 180 };
  }

  /**
   * Show the boxes of a step.
   * @param step number of boxes placed; @param colouring how to colour them;
   * @param marked number of the box with an outline, or -1; @param drop whether the last box falls into place.
   */
  show(step, colouring, marked, drop) {
    this.visible = [];
    for (let i = 0; i < step; i++) {
      if (this.bin === null || this.model.boxes[i].bin === this.bin) this.visible.push(i);
    }
    this.visible.forEach((i, row) => {
      this.mesh.setColorAt(row, new THREE.Color(this.model.colour(i, colouring)));
      this.write(row, 0);
    });
    this.mesh.count = this.visible.length;
    this.edges.geometry.setDrawRange(0, 24 * this.visible.length);
    if (this.mesh.instanceColor) this.mesh.instanceColor.needsUpdate = true;
    this.mark(marked);
    this.dropping = null;
    if (drop && this.visible.at(-1) === step - 1) this.dropping = performance.now();
    this.requestDraw();
  }

  /** Write box `row` of the visible ones, lifted. */
  write(row, lift) {
    const { low, sides, yaw } = this.place(this.model.boxes[this.visible[row]], lift);
    const middle = new THREE.Vector3(...low.map((value, k) => value + sides[k] / 2));
    const turn = new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(0, 0, 1), yaw);
    this.mesh.setMatrixAt(row, new THREE.Matrix4().compose(middle, turn, new THREE.Vector3(...sides)));
    this.mesh.instanceMatrix.needsUpdate = true;
    this.mesh.boundingSphere = null;
    this.writeEdges(this.edges, row, low, sides, yaw);
  }

  /** Outline a visible box; -1 for none. */
  mark(i, lift = 0) {
    const seen = this.visible.includes(i);
    if (seen) {
      const { low, sides, yaw } = this.place(this.model.boxes[i], lift);
      this.writeEdges(this.outline, 0, low, sides, yaw);
    }
    this.marked = i;
    this.outline.geometry.setDrawRange(0, seen ? 24 : 0);
    this.requestDraw();
  }

  /** Outline a placement that was not chosen: {bin, x, y, z, w, d, h}; null for none. */
  showGhost(placement) {
    if (placement && !this.shown.includes(placement.bin)) placement = null;
    if (placement) {
      const { low, sides } = this.place(placement);
      this.writeEdges(this.ghost, 0, low, sides, 0);
    }
    this.ghost.geometry.setDrawRange(0, placement ? 24 : 0);
    this.requestDraw();
  }

  /** The visible box at a point of the canvas in pixels; -1 for none. */
  pick(x, y) {
    const { width, height } = this.canvas.getBoundingClientRect();
    this.raycaster.setFromCamera(new THREE.Vector2((2 * x) / width - 1, 1 - (2 * y) / height), this.camera);
    const [hit] = this.mesh.count ? this.raycaster.intersectObject(this.mesh) : [];
    return hit ? this.visible[hit.instanceId] : -1;
  }

  /** The point of the canvas in pixels where the middle of a box is. */
  project(i) {
    const { low, sides } = this.place(this.model.boxes[i]);
    const point = new THREE.Vector3(...low.map((value, k) => value + sides[k] / 2)).project(this.camera);
    const { width, height } = this.canvas.getBoundingClientRect();
    return [((point.x + 1) * width) / 2, ((1 - point.y) * height) / 2];
  }

  /** Look at all shown bins from the front, right and above. */
  reset() {
    this.moved = false;
    if (!this.shown) return;
    const low = [Infinity, Infinity, 0];
    const high = [-Infinity, -Infinity, 0];
    for (const k of this.shown) {
      const [x, y] = this.origin(k);
      const sides = this.model.bins[k].map((side) => side / this.unit);
      [x, y, 0].forEach((value, a) => {
        low[a] = Math.min(low[a], value);
        high[a] = Math.max(high[a], value + sides[a]);
      });
    }
    const middle = new THREE.Vector3(...low.map((value, a) => (value + high[a]) / 2));
    const away = new THREE.Vector3(0.53, -0.85, 0.52).normalize();
    const right = new THREE.Vector3(0, 0, 1).cross(away).normalize();
    const up = away.clone().cross(right);
    const tangent = Math.tan((this.camera.fov * Math.PI) / 360);
    let distance = 1;
    for (const corner of CORNERS) {
      const at = new THREE.Vector3(...corner.map((share, a) => low[a] + share * (high[a] - low[a]))).sub(middle);
      const across = Math.abs(at.dot(right)) / (tangent * this.camera.aspect);
      distance = Math.max(distance, at.dot(away) + MARGIN * Math.max(across, Math.abs(at.dot(up)) / tangent));
    }
    this.controls.target.copy(middle);
    this.camera.position.copy(middle).addScaledVector(away, distance);
    this.controls.minDistance = distance / 20;
    this.controls.maxDistance = distance * 5;
    this.camera.near = distance / 100;
    this.camera.far = distance * 10;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.requestDraw();
  }

  /** Turn the camera around the bins by angles in radians. */
  turn(around, up) {
    this.moved = true;
    const offset = this.camera.position.clone().sub(this.controls.target);
    const axis = new THREE.Vector3(0, 0, 1).cross(offset).normalize();
    offset.applyAxisAngle(new THREE.Vector3(0, 0, 1), around);
    const height = Math.asin(offset.z / offset.length());
    const room = Math.PI / 2 - 0.05;
    const lift = Math.min(room, Math.max(-room, height + up)) - height;
    offset.applyAxisAngle(axis, -lift);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
  }

  /** Come nearer by a factor above 1. */
  zoom(factor) {
    this.moved = true;
    this.camera.position.sub(this.controls.target).divideScalar(factor).add(this.controls.target);
    this.controls.update();
    this.requestDraw();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (!this.moved) this.reset();
    this.requestDraw();
  }

  /** Draw soon; nothing is drawn while nothing changes. */
  requestDraw() {
    this.frame ??= requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.frame = null;
    if (this.dropping !== null && this.dropping !== undefined && this.visible.length) {
      const share = Math.min(1, (performance.now() - this.dropping) / DROP_MS);
      const lift = 4 * (1 - share) ** 2;
      const row = this.visible.length - 1;
      this.write(row, lift);
      if (this.marked === this.visible[row]) this.mark(this.marked, lift);
      if (share === 1) this.dropping = null;
      else this.requestDraw();
    }
    this.renderer.render(this.scene, this.camera);
    if (!this.drawn) performance.mark("first picture");
    this.drawn = true;
  }
}
