// Images on a regular grid of nodes: finer ones by interpolation, and the outline at a level.
// An image is {values, nx, ny}, values[iy * nx + ix], row 0 at the bottom.

/** The image with `factor` times as many intervals, by Catmull-Rom splines through the nodes. */
export function upsample(image, factor) {
  const rows = alongRows(image.values, image.ny, image.nx, factor);
  const nx = (image.nx - 1) * factor + 1;
  const turned = transpose(rows, image.ny, nx);
  const ny = (image.ny - 1) * factor + 1;
  return { values: transpose(alongRows(turned, nx, image.ny, factor), nx, ny), nx, ny };
}

function alongRows(values, rows, n, factor) {
  const fine = (n - 1) * factor + 1;
  const out = new Float32Array(rows * fine);
  for (let row = 0; row < rows; row++) {
    const at = (i) => values[row * n + Math.min(Math.max(i, 0), n - 1)] || 0;  // NaN counts as 0
    for (let i = 0; i < n; i++) {
      const [a, b, c, d] = [at(i - 1), at(i), at(i + 1), at(i + 2)];
      const steps = i < n - 1 ? factor : 1;
      for (let k = 0; k < steps; k++) {
        const t = k / factor;
        out[row * fine + i * factor + k] =
          b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)));
      }
    }
  }
  return out;
}

function transpose(values, rows, columns) {
  const out = new Float32Array(values.length);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      out[column * rows + row] = values[row * columns + column];
    }
  }
  return out;
}

// Marching squares. Corners are numbered counter-clockwise from the lower left one, edge k leads
// from corner k to the next; for each set of corners above the level, the edges that the outline
// joins. The two ambiguous sets (5 and 10) are cut as two separate corners.
const JOINED = [
  [], [3, 0], [0, 1], [3, 1], [1, 2], [3, 0, 1, 2], [0, 2], [3, 2],
  [2, 3], [2, 0], [0, 1, 2, 3], [2, 1], [1, 3], [1, 0], [0, 3], [],
];
const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];

/** The outline at `level` as segments [x0, y0, x1, y1, ...] in units of node spacings. */
export function contour({ values, nx, ny }, level) {
  const segments = [];
  const corner = new Float64Array(4);
  for (let iy = 0; iy < ny - 1; iy++) {
    for (let ix = 0; ix < nx - 1; ix++) {
      const first = iy * nx + ix;
      corner[0] = values[first];
      corner[1] = values[first + 1];
      corner[2] = values[first + nx + 1];
      corner[3] = values[first + nx];
      let above = 0;
      for (let k = 0; k < 4; k++) if (corner[k] > level) above |= 1 << k;
      for (const edge of JOINED[above]) {
        const next = (edge + 1) % 4;
        const t = (level - corner[edge]) / (corner[next] - corner[edge]);
        const [ax, ay] = CORNERS[edge];
        const [bx, by] = CORNERS[next];
        segments.push(ix + ax + t * (bx - ax), iy + ay + t * (by - ay));
      }
    }
  }
  return segments;
}
