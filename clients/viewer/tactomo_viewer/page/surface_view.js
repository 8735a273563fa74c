// Draws a mounted sheet on its surface: the image, contacts with arrows of force, and presses. It is
// turned by dragging beside the sheet, with the right button or by the arrow keys, zoomed by the
// wheel, and pressed as the flat map is. Drawn by three.js (three.module.min.js, MIT).

import * as THREE from "./three.module.min.js";

import { SIZE, colourTable, contactColour } from "./colormap.js";
import { forceOf } from "./values.js";

const FIELD_OF_VIEW = 35;       // degrees
const LARGEST_ARROW = 0.45;     // of the surface's radius, at the top of the scale
const LEAST_ARROW = 0.12;
const FULL_FORCE_N = 100;       // a firm push of a hand; larger forces have the largest arrow
const LIFT = 0.004;             // of the radius: what lies on the surface is not hidden by it
const SEEN = 0.93;              // of the picture's half width: where a number is not cut off
const RING_POINTS = 48;
const CUT_OUT_PX = 1024;
const EDGE_STEPS = 24;          // of an edge of the outline, which follows the surface
const TURN_PER_PX = 0.008;      // radians
const TURN_PER_KEY = 0.1;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class SurfaceView {
  /** `flat` is the MapView of the same sheet, `onTurn()` is called when the view has been turned. */
  constructor(canvas, flat, onTurn) {
    Object.assign(this, { canvas, flat, onTurn });
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 100);
    this.body = new THREE.Group();     // what is turned; 1 is the surface's radius
    this.marks = new THREE.Group();    // contacts and presses, made anew with each frame
    this.body.add(this.marks);
    const lamp = new THREE.DirectionalLight(0xffffff, 1.4);
    lamp.position.set(0.4, 0.7, 1);
    this.scene.add(this.body, new THREE.AmbientLight(0xffffff, 2.0), lamp);
    this.distance = 3.6;
    this.labels = new Map();
    this.tables = {};
    this.#listen();
  }

  /** Take the surface from a status's `description.mount`. */
  describe({ surface_m: rows }) {
    this.rows = rows;
    const points = rows.flat().map((point) => new THREE.Vector3(...point));
    const sphere = new THREE.Sphere().setFromPoints(points);
    this.middle = sphere.center;
    this.radius = sphere.radius || 1;
    // The sheet's middle faces the viewer, its y upwards.
    const [across, up, out] = this.#axes(0.5, 0.5);
    this.body.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(across, up, out)).invert();
    this.#turn(0.45, 0.3);
    this.shape = "";
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(window.devicePixelRatio || 1);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  /** The point of the sheet, in mm, that is seen at a place on the canvas; NaN beside the sheet. */
  pixelToMm(px, py) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const at = new THREE.Vector2((2 * px) / width - 1, 1 - (2 * py) / height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(at, this.camera);
    const hit = this.mesh && ray.intersectObject(this.mesh)[0];
    if (!hit) return [NaN, NaN];
    const { x: [x0, x1], y: [y0, y1] } = this.flat.sheet;
    return [x0 + (x1 - x0) * hit.uv.x, y0 + (y1 - y0) * hit.uv.y];
  }

  /** Where a point of the sheet, in mm, is seen on the canvas. */
  mmToPixel(x, y) {
    this.body.updateMatrixWorld();
    const seen = this.#place(x, y).applyMatrix4(this.body.matrixWorld).project(this.camera);
    return [((seen.x + 1) / 2) * this.canvas.clientWidth, ((1 - seen.y) / 2) * this.canvas.clientHeight];
  }

  isOnSheet(x, y) {
    return this.flat.isOnSheet(x, y);
  }

  /** Draw a scene, as `MapView.draw` takes it. */
  draw(scene) {
    if (!this.rows) return;
    this.#colour(scene);
    this.#clearMarks();
    this.camera.position.set(0, 0, this.distance);
    this.camera.updateMatrixWorld();
    this.body.updateMatrixWorld();
    const theme = getComputedStyle(this.canvas);
    this.#rim(theme.getPropertyValue("--axis").trim());
    this.#electrodes(theme.getPropertyValue("--electrode").trim());
    for (const press of scene.presses) this.#press(press, theme.getPropertyValue("--pressing").trim());
    for (const contact of scene.frame?.contacts ?? []) this.#contact(contact);
    this.renderer.render(this.scene, this.camera);
  }

  #clearMarks() {
    for (const mark of this.marks.children) {
      if (mark.isSprite) continue;  // kept, by its number
      mark.dispose?.();
      mark.geometry?.dispose();
      mark.material?.dispose();
    }
    this.marks.clear();
  }

  // A place given as shares of the sheet's width and height, from the lower left.
  #at(u, v) {
    const { rows } = this;
    const [x, y] = [u * (rows[0].length - 1), v * (rows.length - 1)];
    const column = Math.max(0, Math.min(rows[0].length - 2, Math.floor(x)));
    const row = Math.max(0, Math.min(rows.length - 2, Math.floor(y)));
    const [right, up] = [x - column, y - row];
    const corner = (dy, dx) => new THREE.Vector3(...rows[row + dy][column + dx]);
    const below = corner(0, 0).lerp(corner(0, 1), right);
    return this.#scaled(below.lerp(corner(1, 0).lerp(corner(1, 1), right), up));
  }

  #scaled(point) {
    return point.sub(this.middle).divideScalar(this.radius);
  }

  #place(x, y) {
    const { x: [x0, x1], y: [y0, y1] } = this.flat.sheet;
    return this.#at((x - x0) / (x1 - x0), (y - y0) / (y1 - y0));
  }

  // The sheet's x, y and normal at a place, as unit vectors.
  #axes(u, v) {
    const step = 0.02;
    const across = this.#at(u + step, v).sub(this.#at(u - step, v)).normalize();
    const out = across.clone().cross(this.#at(u, v + step).sub(this.#at(u, v - step))).normalize();
    return [across, out.clone().cross(across), out];
  }

  // The mesh has a node for each one of the image, so that no pressure is seen where none is felt.
  #makeMesh(nx, ny, isThere) {
    if (this.mesh) {
      this.body.remove(this.mesh);
      this.mesh.geometry.dispose();
      this.mesh.material.alphaMap.dispose();
      this.mesh.material.dispose();
    }
    const geometry = new THREE.BufferGeometry();
    const [places, uv, corners] = [[], [], []];
    for (let iy = 0; iy < ny; iy++) {
      for (let ix = 0; ix < nx; ix++) {
        const [u, v] = [ix / (nx - 1), iy / (ny - 1)];
        places.push(...this.#at(u, v).toArray());
        uv.push(u, v);
        const node = iy * nx + ix;
        const square = [node, node + 1, node + nx + 1, node + nx];
        if (ix < nx - 1 && iy < ny - 1 && square.some(isThere)) {
          corners.push(square[0], square[1], square[2], square[0], square[2], square[3]);
        }
      }
    }
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(places, 3));
    geometry.setAttribute("uv", new THREE.Float32BufferAttribute(uv, 2));
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(new Float32Array(3 * nx * ny), 3));
    geometry.setIndex(corners);
    geometry.computeVertexNormals();
    const material = new THREE.MeshLambertMaterial({
      vertexColors: true, side: THREE.DoubleSide, alphaMap: this.#cutOut(), alphaTest: 0.5,
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.body.add(this.mesh);
  }

  // White where the sheet is: the mesh is cut along the outline, not along the map's nodes.
  #cutOut() {
    const { x: [x0, x1], y: [y0, y1], outline } = this.flat.sheet;
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = CUT_OUT_PX;
    const c = canvas.getContext("2d");
    for (const ring of outline) {
      ring.forEach(([x, y], corner) => {
        const at = [(x - x0) / (x1 - x0), (y1 - y) / (y1 - y0)].map((share) => share * CUT_OUT_PX);
        if (corner) c.lineTo(...at);
        else c.moveTo(...at);
      });
      c.closePath();
    }
    c.fillStyle = "#ffffff";
    c.fill("evenodd");
    return new THREE.CanvasTexture(canvas);
  }

  #colour({ image, frame, scale, colormap }) {
    const structure = frame?.images.structure;
    const source = image ?? structure ?? { nx: this.rows[0].length, ny: this.rows.length, values: [] };
    const known = structure ?? source;
    const shape = `${source.nx} ${source.ny}`;
    if (shape !== this.shape) {
      this.#makeMesh(source.nx, source.ny, (node) => !Number.isNaN(known.values[node]));
      this.shape = shape;
    }
    const table = (this.tables[colormap] ??= colourTable(colormap));
    const pressed = getComputedStyle(this.canvas).getPropertyValue("--pressed").split(" ").map(Number);
    const colours = this.mesh.geometry.getAttribute("color");
    const mixed = new THREE.Color();
    for (let node = 0; node < colours.count; node++) {
      const value = image ? image.values[node] : 0;
      const level = 3 * Math.max(0, Math.min(SIZE - 1, Math.round((value / scale) * (SIZE - 1)))) || 0;
      let rgb = table.subarray(level, level + 3);
      const touched = structure?.values[node] ?? 0;
      if (touched > 0.5 && !(image && Number.isFinite(value))) rgb = pressed;
      mixed.setRGB(rgb[0] / 255, rgb[1] / 255, rgb[2] / 255, THREE.SRGBColorSpace);
      colours.setXYZ(node, mixed.r + 0.02, mixed.g + 0.02, mixed.b + 0.03);  // a dark sheet has a shape, too
    }
    colours.needsUpdate = true;
  }

  #rim(colour) {
    const steps = Array.from({ length: EDGE_STEPS }, (_, i) => i / EDGE_STEPS);
    for (const ring of this.flat.sheet.outline) {
      const points = ring.flatMap(([ax, ay], corner) => {
        const [bx, by] = ring[(corner + 1) % ring.length];
        return steps.map((t) => this.#place(ax + t * (bx - ax), ay + t * (by - ay)));
      });
      const geometry = new THREE.BufferGeometry().setFromPoints(points);
      this.marks.add(new THREE.LineLoop(geometry, new THREE.LineBasicMaterial({ color: colour })));
    }
  }

  #electrodes(colour) {
    const places = this.flat.sheet.electrodes.map(([x, y]) => this.#place(x, y));
    const geometry = new THREE.BufferGeometry().setFromPoints(places);
    this.marks.add(new THREE.Points(geometry, new THREE.PointsMaterial({ color: colour, size: 0.06 })));
  }

  #press({ x, y, size, shape }, colour) {
    const square = [[-1, -1], [1, -1], [1, 1], [-1, 1]];
    const ring = Array.from({ length: RING_POINTS }, (_, i) => [
      Math.cos((2 * Math.PI * i) / RING_POINTS), Math.sin((2 * Math.PI * i) / RING_POINTS),
    ]);
    const points = (shape === "rectangle" ? square : ring)
      .map(([dx, dy]) => [x + (dx * size) / 2, y + (dy * size) / 2])
      .filter(([px, py]) => this.isOnSheet(px, py))
      .map(([px, py]) => this.#lifted(px, py, 3 * LIFT));
    const geometry = new THREE.BufferGeometry().setFromPoints(points);
    this.marks.add(new THREE.LineLoop(geometry, new THREE.LineBasicMaterial({ color: colour })));
  }

  #lifted(x, y, height) {
    const { x: [x0, x1], y: [y0, y1] } = this.flat.sheet;
    const [, , out] = this.#axes((x - x0) / (x1 - x0), (y - y0) / (y1 - y0));
    return this.#place(x, y).addScaledVector(out, height);
  }

  // An arrow from outside onto the contact, the longer the larger the force, and its number.
  #contact(contact) {
    if (!contact.position_m || !contact.normal) return;
    const out = new THREE.Vector3(...contact.normal);
    const foot = this.#scaled(new THREE.Vector3(...contact.position_m)).addScaledVector(out, LIFT);
    const { value, low } = forceOf(contact);
    const force = value ?? (Number.isFinite(low) ? low : 0);
    const length = LEAST_ARROW + (LARGEST_ARROW - LEAST_ARROW) * Math.min(1, force / FULL_FORCE_N);
    const from = foot.clone().addScaledVector(out, length);
    const colour = contactColour(contact.id);
    this.marks.add(new THREE.ArrowHelper(out.clone().negate(), from, length, colour, 0.09, 0.06));
    const label = this.#label(contact.id, colour);
    // Where the arrow leaves the picture, the number stays in it.
    const along = [1, 0.75, 0.5, 0.25, 0].map((share) => foot.clone().addScaledVector(out, share * length + 0.07));
    label.position.copy(along.find((spot) => this.#isSeen(spot)) ?? along.at(-1));
    this.marks.add(label);
  }

  #isSeen(spot) {
    const { x, y } = spot.clone().applyMatrix4(this.body.matrixWorld).project(this.camera);
    return Math.max(Math.abs(x), Math.abs(y)) < SEEN;
  }

  #label(id, colour) {
    if (!this.labels.has(id)) {
      const canvas = document.createElement("canvas");
      canvas.width = canvas.height = 64;
      const c = canvas.getContext("2d");
      c.fillStyle = colour;
      c.arc(32, 32, 30, 0, 7);
      c.fill();
      c.fillStyle = "#10131c";
      c.font = "600 32px system-ui, sans-serif";
      c.textAlign = "center";
      c.textBaseline = "middle";
      c.fillText(String(id), 32, 34);
      const map = new THREE.CanvasTexture(canvas);
      map.colorSpace = THREE.SRGBColorSpace;
      const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthTest: false }));
      sprite.scale.set(0.13, 0.13, 1);
      if (this.labels.size > 200) this.labels.clear();  // identities are never used again
      this.labels.set(id, sprite);
    }
    return this.labels.get(id);
  }

  #turn(about_y, about_x) {
    const turn = new THREE.Quaternion().setFromEuler(new THREE.Euler(about_x, about_y, 0));
    this.body.quaternion.premultiply(turn);
  }

  #listen() {
    const { canvas } = this;
    let last = null;
    canvas.addEventListener("pointerdown", (event) => {
      const presses = canvas.classList.contains("pressable") && event.button === 0;
      if (presses && this.isOnSheet(...this.pixelToMm(event.offsetX, event.offsetY))) return;
      last = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", ({ clientX, clientY }) => {
      if (!last) return;
      this.#turn(TURN_PER_PX * (clientX - last[0]), TURN_PER_PX * (clientY - last[1]));
      last = [clientX, clientY];
      this.onTurn();
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { last = null; });
    canvas.addEventListener("keydown", (event) => {
      const arrow = ARROWS[event.key];
      if (!arrow || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      this.#turn(TURN_PER_KEY * arrow[0], TURN_PER_KEY * arrow[1]);
      this.onTurn();
    });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.distance = Math.max(1.6, Math.min(9, this.distance * Math.exp(0.001 * event.deltaY)));
      this.onTurn();
    }, { passive: false });
  }
}
