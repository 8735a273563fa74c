// Draws a frame on the canvas: the sheet with its image, outline, contacts and presses; axes in
// millimetres; the colour bar. Knows where each millimetre lies, and says so to others.

import { SIZE, colourTable, contactColour } from "./colormap.js";
import { contour, upsample } from "./grid.js";

const FINER = 5;           // intervals of the smooth image for each one of the map
const OUTLINE_FINER = 3;
const ELECTRODE_MM = [6, 2.4];  // drawn size: along the rim, across it
const NARROW_PX = 520;     // below this the colour bar lies under the map
const MARK_PX = 8;         // from a contact's rim to its mark
const LABEL_HEIGHT = 22;   // px
const TICK_PX = 28;        // the least room of a number under the map

/** The corners of a sheet's bounding box. */
function box({ x: [x0, x1], y: [y0, y1] }) {
  return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
}

/** The edges of rings of corners: pairs of points. */
function edges(rings) {
  return rings.flatMap((ring) => ring.map((corner, i) => [corner, ring[(i + 1) % ring.length]]));
}

/** How far off a point the nearest edge is, and its direction, left of which the sheet lies. */
function nearestEdge(rings, x, y) {
  let [least, found] = [Infinity, [1, 0]];
  for (const [[ax, ay], [bx, by]] of edges(rings)) {
    const [ex, ey] = [bx - ax, by - ay];
    const length = Math.hypot(ex, ey) || 1;
    const share = Math.max(0, Math.min(1, ((x - ax) * ex + (y - ay) * ey) / length ** 2));
    const off = Math.hypot(x - ax - share * ex, y - ay - share * ey);
    if (off < least) [least, found] = [off, [ex / length, ey / length]];
  }
  return { off: least, along: found };
}

export class MapView {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.picture = document.createElement("canvas");  // the image, one pixel a node
    this.sheet = { x: [-75, 75], y: [-75, 75], electrodes: [], padRadii: [], sensing: [] };
    this.sheet.outline = [box(this.sheet)];
    this.tables = {};
    this.resize();
  }

  /** Take the sheet's geometry from the description in a status message. */
  describe(description) {
    const [w, h] = [description.width_mm, description.height_mm];
    if (!(w > 0 && h > 0)) return;
    const list = (given) => (Array.isArray(given) ? given : []);
    this.sheet = {
      x: [-w / 2, w / 2],
      y: [-h / 2, h / 2],
      sensing: list(description.sensing_outline_mm),
      electrodes: list(description.electrodes_mm),
      padRadii: list(description.pad_radii_mm),
    };
    const outline = list(description.outline_mm);
    this.sheet.outline = outline.length ? outline : [box(this.sheet)];
    this.resize();
  }

  /** Fit the canvas into the room there is; call when that or the sheet changed. */
  resize() {
    const { canvas, sheet } = this;
    const size = [canvas.clientWidth, canvas.clientHeight];
    const narrow = size[0] < NARROW_PX;
    const margin = narrow
      ? { left: 40, right: 14, top: 8, bottom: 84 }
      : { left: 52, right: 84, top: 10, bottom: 44 };
    const [wide, high] = [sheet.x[1] - sheet.x[0], sheet.y[1] - sheet.y[0]];
    const room = [size[0] - margin.left - margin.right, size[1] - margin.top - margin.bottom];
    const scale = Math.max(0.2, Math.min(room[0] / wide, room[1] / high));
    const [w, h] = [wide * scale, high * scale];
    // What is left over is shared out, so that the map stands in the middle.
    const left = margin.left + Math.max(0, (room[0] - w) / 2);
    const top = margin.top + Math.max(0, (room[1] - h) / 2);
    this.plot = { left, top, width: w, height: h, scale, narrow };
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(size[0] * ratio);
    canvas.height = Math.round(size[1] * ratio);
    this.size = size;
    this.ratio = ratio;
    canvas.dataset.xMm = sheet.x.join(" ");
    canvas.dataset.yMm = sheet.y.join(" ");
  }

  /** The place of a point of the skin on the canvas, CSS pixels from its upper left corner. */
  mmToPixel(x, y) {
    const { left, top, scale } = this.plot;
    return [left + (x - this.sheet.x[0]) * scale, top + (this.sheet.y[1] - y) * scale];
  }

  /** The point of the skin, in mm, at a place on the canvas. */
  pixelToMm(px, py) {
    const { left, top, scale } = this.plot;
    return [this.sheet.x[0] + (px - left) / scale, this.sheet.y[1] - (py - top) / scale];
  }

  /** Whether a point in mm lies on the sheet. */
  isOnSheet(x, y) {
    let inside = false;
    for (const [[ax, ay], [bx, by]] of edges(this.sheet.outline)) {
      if (ay > y !== by > y && x < ax + ((y - ay) / (by - ay)) * (bx - ax)) inside = !inside;
    }
    return inside;
  }

  /** A point of the sheet, in mm: its centre, or the nearest to that which is well inside. */
  middle() {
    const { outline, x: [x0, x1], y: [y0, y1] } = this.sheet;
    const clear = Math.min(x1 - x0, y1 - y0) / 10;
    const shares = Array.from({ length: 21 }, (_, i) => i / 20);
    const spots = shares.flatMap((sx) => shares.map((sy) => [x0 + sx * (x1 - x0), y0 + sy * (y1 - y0)]))
      .filter((spot) => this.isOnSheet(...spot) && nearestEdge(outline, ...spot).off > clear);
    return spots.sort((a, b) => Math.hypot(...a) - Math.hypot(...b))[0] ?? [0, 0];
  }

  /**
   * Draw everything. `scene` has: frame (or null), image (what to colour, or null), scale (its top),
   * unit (for the colour bar), label(contact), colormap, smooth, outline,
   * presses (list of {x, y, size, shape, pressure}), cursor ([x, y] or null), marked (a contact's id).
   */
  draw(scene) {
    const c = this.context;
    this.theme = theme(this.canvas);
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.clearRect(0, 0, ...this.size);
    this.#axes(c);
    c.save();
    this.#path(c, this.sheet.outline);
    c.clip("evenodd");
    this.#image(c, scene);
    c.restore();
    this.#rim(c);
    if (scene.outline && scene.frame?.images.structure) this.#outline(c, scene.frame);
    for (const press of scene.presses) this.#press(c, press);
    if (scene.cursor) this.#cursor(c, scene.cursor);
    this.labels = [];
    for (const contact of scene.frame?.contacts ?? []) {
      if (contact.id === scene.marked) this.#mark(c, contact);
      this.#contact(c, contact, scene.label(contact));
    }
    if (scene.image) this.#colourBar(c, scene);
  }

  #table(name) {
    return (this.tables[name] ??= colourTable(name));
  }

  #path(c, rings) {
    c.beginPath();
    for (const ring of rings) {
      ring.forEach((corner, i) => c[i ? "lineTo" : "moveTo"](...this.mmToPixel(...corner)));
      c.closePath();
    }
  }

  #image(c, { image, frame, scale, colormap, smooth }) {
    const table = this.#table(colormap);
    const structure = frame?.images.structure;
    c.fillStyle = image || !structure ? rgb(table, 0) : this.theme.sheet;
    c.fillRect(this.plot.left, this.plot.top, this.plot.width, this.plot.height);
    const source = image ?? structure;
    if (!source) return;
    const values = (pixels, at, value) => {
      const level = 3 * Math.max(0, Math.min(SIZE - 1, Math.round((value / scale) * (SIZE - 1)))) || 0;
      pixels[at] = table[level];
      pixels[at + 1] = table[level + 1];
      pixels[at + 2] = table[level + 2];
      pixels[at + 3] = 255;
    };
    const touched = (pixels, at, value) => {
      pixels.set(this.theme.pressed, at);
      pixels[at + 3] = 200 * Math.max(0, Math.min(1, value)) || 0;
    };
    this.#paint(c, frame, source, smooth, image ? values : touched);
    if (image && structure && image.values.some(Number.isNaN)) {
      const unknown = structure.values.map((value, i) => (Number.isNaN(image.values[i]) ? value : 0));
      this.#paint(c, frame, { ...structure, values: unknown }, smooth, touched);
    }
  }

  /** Colour the nodes of an image: `paint(pixels, at, value)` sets one. */
  #paint(c, frame, source, smooth, paint) {
    const nodes = smooth ? upsample(source, FINER) : source;
    const pixels = c.createImageData(nodes.nx, nodes.ny);
    for (let iy = 0; iy < nodes.ny; iy++) {
      for (let ix = 0; ix < nodes.nx; ix++) {
        const at = 4 * ((nodes.ny - 1 - iy) * nodes.nx + ix);
        paint(pixels.data, at, nodes.values[iy * nodes.nx + ix]);
      }
    }
    this.picture.width = nodes.nx;
    this.picture.height = nodes.ny;
    this.picture.getContext("2d").putImageData(pixels, 0, 0);
    const [x0, x1] = frame.x_mm;
    const [y0, y1] = frame.y_mm;
    const [dx, dy] = [(x1 - x0) / (nodes.nx - 1) / 2, (y1 - y0) / (nodes.ny - 1) / 2];
    const [left, top] = this.mmToPixel(x0 - dx, y1 + dy);  // a node is the middle of its pixel
    const [right, bottom] = this.mmToPixel(x1 + dx, y0 - dy);
    c.imageSmoothingEnabled = smooth;
    c.imageSmoothingQuality = "high";
    c.drawImage(this.picture, left, top, right - left, bottom - top);
  }

  #outline(c, frame) {
    const fine = upsample(frame.images.structure, OUTLINE_FINER);
    const [x0, x1] = frame.x_mm;
    const [y0, y1] = frame.y_mm;
    const segments = contour(fine, 0.5);
    c.beginPath();
    for (let i = 0; i < segments.length; i += 2) {
      const point = this.mmToPixel(
        x0 + ((x1 - x0) * segments[i]) / (fine.nx - 1),
        y0 + ((y1 - y0) * segments[i + 1]) / (fine.ny - 1),
      );
      if (i % 4 === 0) c.moveTo(...point);
      else c.lineTo(...point);
    }
    c.lineCap = "round";
    halo(c, 2, "#ffffff", "rgba(0, 0, 0, 0.65)");
  }

  #contact(c, contact, label) {
    const [x, y] = this.mmToPixel(contact.x_mm, contact.y_mm);
    c.beginPath();
    c.arc(x, y, 2.5, 0, 7);
    halo(c, 2, "#ffffff", "rgba(0, 0, 0, 0.7)");
    c.font = `600 12px ${this.theme.font}`;
    const number = String(contact.id);
    const numberWidth = Math.max(20, c.measureText(number).width + 10);
    const width = numberWidth + c.measureText(label).width + 14;
    const { left, top, width: w, height: h } = this.plot;
    const end = this.plot.narrow ? this.size[0] : left + w;
    const [right, above, below] = [Math.min(x + 10, end - width - 2), y - 34, y + 12];
    const beside = Math.max(left + 2, x - 10 - width);
    const spots = [above, below, above - LABEL_HEIGHT, below + LABEL_HEIGHT]
      .flatMap((spot) => [[right, spot], [beside, spot]])
      .filter(([, spot]) => spot >= top && spot + LABEL_HEIGHT <= top + h);
    const isFree = ([sx, sy]) => this.labels.every(([lx, ly, lw]) =>
      sx > lx + lw || lx > sx + width || Math.abs(sy - ly) >= LABEL_HEIGHT);
    const [bx, by] = spots.find(isFree) ?? spots[0] ?? [right, below];
    this.labels.push([bx, by, width]);
    c.beginPath();
    c.roundRect(bx, by, width, LABEL_HEIGHT, 11);
    c.fillStyle = "rgba(10, 12, 20, 0.82)";
    c.fill();
    c.beginPath();
    c.roundRect(bx, by, numberWidth, LABEL_HEIGHT, 11);
    c.fillStyle = contactColour(contact.id);
    c.fill();
    c.textBaseline = "middle";
    c.textAlign = "center";
    c.fillStyle = "#10131c";
    c.fillText(number, bx + numberWidth / 2, by + 11.5);
    c.textAlign = "left";
    c.fillStyle = "#ffffff";
    c.fillText(label, bx + numberWidth + 6, by + 11.5);
  }

  // A circle around as much as the contact covers.
  #mark(c, { id, x_mm: x, y_mm: y, area_mm2: area }) {
    c.beginPath();
    c.arc(...this.mmToPixel(x, y), Math.sqrt(area / Math.PI) * this.plot.scale + MARK_PX, 0, 7);
    halo(c, 3, contactColour(id), "rgba(0, 0, 0, 0.65)");
  }

  #press(c, { x, y, size, shape }) {
    const [px, py] = this.mmToPixel(x, y);
    const r = (size / 2) * this.plot.scale;
    c.beginPath();
    if (shape === "rectangle") c.rect(px - r, py - r, 2 * r, 2 * r);
    else c.arc(px, py, r, 0, 7);
    if (shape === "ring") {  // its inner half is left out
      c.moveTo(px + r / 2, py);
      c.arc(px, py, r / 2, 0, 7);
    }
    c.setLineDash([5, 4]);
    halo(c, 1.5, "#6fe3ff", "rgba(0, 0, 0, 0.55)");
    c.setLineDash([]);
  }

  #cursor(c, [x, y]) {
    const [px, py] = this.mmToPixel(x, y);
    c.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      c.moveTo(px + 4 * dx, py + 4 * dy);
      c.lineTo(px + 13 * dx, py + 13 * dy);
    }
    halo(c, 1.5, "#6fe3ff", "rgba(0, 0, 0, 0.55)");
  }

  #rim(c) {
    const { theme, sheet } = this;
    this.#path(c, sheet.outline);
    c.lineWidth = 1.5;
    c.strokeStyle = theme.axis;
    c.stroke();
    this.#path(c, sheet.sensing);
    c.setLineDash([2, 5]);
    c.lineWidth = 1;
    c.strokeStyle = "rgba(255, 255, 255, 0.4)";
    c.stroke();
    c.setLineDash([]);
    sheet.electrodes.forEach(([x, y], i) => this.#electrode(c, x, y, i));
  }

  // A bar along the edge of the outline that is nearest, and its number inside; or a pad with its number.
  #electrode(c, x, y, i) {
    const { sheet, plot } = this;
    if (sheet.padRadii[i]) return this.#pad(c, x, y, i, sheet.padRadii[i] * plot.scale);
    const [dx, dy] = nearestEdge(sheet.outline, x, y).along;
    if (!plot.narrow) {
      const at = [x - (dy * 13) / plot.scale, y + (dx * 13) / plot.scale];
      c.font = `10px ${this.theme.font}`;
      c.fillStyle = "rgba(255, 255, 255, 0.55)";
      c.textAlign = "center";
      c.textBaseline = "middle";
      c.fillText(String(i), ...this.mmToPixel(...at));
    }
    const [along, across] = ELECTRODE_MM.map((mm) => mm * plot.scale);
    c.save();
    c.translate(...this.mmToPixel(x, y));
    c.rotate(-Math.atan2(dy, dx));
    c.beginPath();
    c.roundRect(-along / 2, -across / 2, along, across, across / 2);
    c.fillStyle = this.theme.electrode;
    c.fill();
    c.lineWidth = 1;
    c.strokeStyle = this.theme.background;
    c.stroke();
    c.restore();
  }

  #pad(c, x, y, i, radius) {
    const [px, py] = this.mmToPixel(x, y);
    c.beginPath();
    c.arc(px, py, Math.max(radius, 2), 0, 2 * Math.PI);
    c.strokeStyle = this.theme.electrode;
    c.lineWidth = 2;
    c.stroke();
    if (this.plot.narrow) return;
    c.font = `10px ${this.theme.font}`;
    c.fillStyle = "rgba(255, 255, 255, 0.55)";
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText(String(i), px, radius > 8 ? py : py - radius - 8);
  }

  #axes(c) {
    const { theme, plot: { left, top, width, height }, sheet } = this;
    c.strokeStyle = theme.axis;
    c.fillStyle = theme.text;
    c.font = `12px ${theme.font}`;
    c.lineWidth = 1;
    c.textAlign = "center";
    c.textBaseline = "top";
    for (const x of ticks(sheet.x[0], sheet.x[1], Math.min(6, width / TICK_PX))) {
      const [px] = this.mmToPixel(x, 0);
      line(c, px, top + height + 5, px, top + height + 10);
      c.fillText(number(x), px, top + height + 13);
    }
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const y of ticks(sheet.y[0], sheet.y[1], 6)) {
      const [, py] = this.mmToPixel(0, y);
      line(c, left - 10, py, left - 5, py);
      c.fillText(number(y), left - 13, py + 0.5);
    }
    c.fillStyle = theme.dim;
    c.textAlign = "center";
    c.textBaseline = "top";
    c.fillText("x (mm)", left + width / 2, top + height + 29);
    if (this.plot.narrow) return;
    c.save();
    c.translate(left - 46, top + height / 2);
    c.rotate(-Math.PI / 2);
    c.textBaseline = "middle";
    c.fillText("y (mm)", 0, 0);
    c.restore();
  }

  #colourBar(c, { colormap, scale, unit }) {
    const { theme, plot } = this;
    const table = this.#table(colormap);
    const { left, top, width, height, narrow } = plot;
    const bar = narrow
      ? { x: left, y: top + height + 54, w: width, h: 12 }
      : { x: left + width + 26, y: top, w: 14, h: height };
    const gradient = narrow
      ? c.createLinearGradient(bar.x, 0, bar.x + bar.w, 0)
      : c.createLinearGradient(0, bar.y + bar.h, 0, bar.y);
    for (let i = 0; i <= 32; i++) gradient.addColorStop(i / 32, rgb(table, Math.round((i / 32) * 255)));
    c.beginPath();
    c.roundRect(bar.x, bar.y, bar.w, bar.h, 3);
    c.fillStyle = gradient;
    c.fill();
    c.lineWidth = 1;
    c.strokeStyle = theme.axis;
    c.stroke();
    c.fillStyle = theme.text;
    c.font = `12px ${theme.font}`;
    c.textBaseline = narrow ? "top" : "middle";
    c.textAlign = narrow ? "center" : "left";
    for (const value of ticks(0, scale, narrow ? Math.min(5, bar.w / TICK_PX) : 5)) {
      if (narrow) c.fillText(number(value), bar.x + (value / scale) * bar.w, bar.y + 16);
      else c.fillText(number(value), bar.x + bar.w + 6, bar.y + bar.h * (1 - value / scale) + 0.5);
    }
    c.textAlign = narrow ? "right" : "left";
    c.textBaseline = narrow ? "middle" : "top";
    c.fillStyle = narrow ? rgb(table, 0) : theme.dim;  // in the bar's bright end
    if (narrow) c.font = `600 10px ${theme.font}`;
    c.fillText(unit, narrow ? bar.x + bar.w - 4 : bar.x - 2, bar.y + (narrow ? bar.h / 2 + 0.5 : bar.h + 13));
  }
}

export function theme(element) {
  const style = getComputedStyle(element);
  const of = (name) => style.getPropertyValue(`--${name}`).trim();
  return {
    background: of("card"),
    text: of("text"),
    dim: of("dim"),
    axis: of("axis"),
    line: of("line"),
    accent: of("accent"),
    warn: of("warn"),
    bad: of("bad"),
    electrode: of("electrode"),
    sheet: of("sheet"),
    pressed: of("pressed").split(" ").map(Number),
    font: style.fontFamily,
  };
}

function halo(c, width, inner, outer) {
  c.lineWidth = width + 2.5;
  c.strokeStyle = outer;
  c.stroke();
  c.lineWidth = width;
  c.strokeStyle = inner;
  c.stroke();
}

export function line(c, x0, y0, x1, y1) {
  c.beginPath();
  c.moveTo(x0, y0);
  c.lineTo(x1, y1);
  c.stroke();
}

function rgb(table, level) {
  return `rgb(${table[3 * level]}, ${table[3 * level + 1]}, ${table[3 * level + 2]})`;
}

/** Round values from low to high, about `count` of them. */
export function ticks(low, high, count) {
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = power * ([1, 2, 2.5, 5, 10].find((s) => s * power >= raw) ?? 10);
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) values.push(i * step);
  return values;
}

export function number(value) {
  return String(Math.round(value * 1000) / 1000).replace("-", "−");
}
