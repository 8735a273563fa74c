/* The inner loop of the pressure field's fit: contacts drawn on the mesh, the pressed sheet solved,
 * its voltages differentiated. It does what `scene.pressure_field`, `physics.condensation` and
 * `physics.forward` do in NumPy, array by array, equal to rounding: the theory and its sources stand
 * there. `inner_loop.py` loads it.
 *
 * Matrices are row-major unless their comment says columns: then an (r, c) matrix has its r entries
 * of a column side by side, as BLAS has it. Nothing here reads or writes but the arrays given.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* SciPy's BLAS and LAPACK, whose addresses Python gives. */
static void (*dgemm)(char *, char *, int *, int *, int *, double *, double *, int *, double *,
                     int *, double *, double *, int *);
static void (*dtrsm)(char *, char *, char *, char *, int *, int *, double *, double *, int *,
                     double *, int *);
static void (*dpotrf)(char *, int *, double *, int *, int *);
static void (*dgesv)(int *, int *, double *, int *, int *, double *, int *, int *);

void use_blas(void *gemm, void *trsm, void *potrf, void *gesv) {
  dgemm = gemm, dtrsm = trsm, dpotrf = potrf, dgesv = gesv;
}

/* C (m, n) = alpha op(A) op(B) + beta C, all columns. */
static void multiply(char ta, char tb, int m, int n, int k, double alpha, const double *A, int lda,
                     const double *B, int ldb, double beta, double *C, int ldc) {
  if (m && n)
    dgemm(&ta, &tb, &m, &n, &k, &alpha, (double *)A, &lda, (double *)B, &ldb, &beta, C, &ldc);
}

/* What of a sheet stays the same; see `ForwardModel`. */
typedef struct {
  int64_t triangles, support, pressable, fields, pairs, products, voltages;
  int64_t most_around, most_near; /* columns of triangles_of, of neighbours */
  const int64_t *corner_support;   /* (triangles, 3) */
  const int64_t *corner_pressable; /* (triangles, 3), -1 elsewhere */
  const int64_t *triangles_of;     /* (pressable, most_around), filled up with `triangles` */
  const int64_t *neighbours;       /* (support, most_near), filled up with `support` */
  const int64_t *triangle_count;   /* (support,) */
  const uint8_t *closed;           /* (support,) */
  const double *gradient;          /* (triangles, 2, 3) */
  const double *stiffness;         /* (triangles, 3, 3) */
  const double *area;              /* (triangles,) */
  const double *conductivity;      /* (triangles,) of the bare sheet */
  const double *transfer;          /* (fields + 1, fields + 1) of the bare sheet */
  const int64_t *electrodes;       /* (voltages, 4): source, sink, v+, v- */
  const int64_t *pair;             /* (pairs, 2): field that counts, field that is taken off */
  const int64_t *product;          /* (products, 2): the pairs of each */
  const int64_t *product_of;       /* (voltages,) */
  const double *sign;              /* (voltages,) */
} Sheet;

/* The areas around pressed nodes: a Condensation and where it is; (t,) triangles, (n,) nodes. */
typedef struct {
  int64_t triangles, nodes, layers, rim, near;
  int64_t *triangle; /* (t,) */
  int64_t *corner;   /* (t, 3) places among the nodes */
  int64_t *node;     /* (n,) positions in the support, area by area, layer by layer inwards */
  int64_t *start;    /* (layers + 1,) */
  int64_t *depth;    /* (n,) */
  int64_t *layer;    /* (n,) */
} Areas;

/* Find the areas around nodes (count,); buffers of `areas` are large enough for any. */
int find_areas(const Sheet *s, int64_t count, const int64_t *where, Areas *a) {
  int64_t S = s->support, t = 0, n = 0;
  int64_t *place = malloc(sizeof(int64_t) * (5 * S + 2));
  uint8_t *hit = calloc(s->triangles + 1 + S, 1);
  if (!place || !hit) {
    free(place), free(hit);
    return -1;
  }
  int64_t *here = place + S, *depth = here + S, *part = depth + S, *queue = part + S;
  uint8_t *there = hit + s->triangles + 1;
  for (int64_t i = 0; i < count; i++)
    for (int64_t j = 0; j < s->most_around; j++) hit[s->triangles_of[where[i] * s->most_around + j]] = 1;
  for (int64_t i = 0; i < s->triangles; i++)
    if (hit[i]) {
      a->triangle[t++] = i;
      for (int c = 0; c < 3; c++) there[s->corner_support[3 * i + c]] = 1;
    }
  memset(here, 0, sizeof(int64_t) * S);
  for (int64_t i = 0; i < t; i++)
    for (int c = 0; c < 3; c++) here[s->corner_support[3 * a->triangle[i] + c]]++;
  /* Depths from all rims at once. */
  int64_t head = 0, tail = 0;
  for (int64_t i = 0; i < S; i++) {
    depth[i] = part[i] = -1;
    if (!there[i]) continue;
    n++;
    if (!s->closed[i] || here[i] < s->triangle_count[i]) depth[i] = 0, queue[tail++] = i;
  }
  for (; head < tail; head++)
    for (int64_t j = 0; j < s->most_near; j++) {
      int64_t next = s->neighbours[queue[head] * s->most_near + j];
      if (next < S && there[next] && depth[next] < 0)
        depth[next] = depth[queue[head]] + 1, queue[tail++] = next;
    }
  /* Connected parts, and within each the nodes by depth. */
  a->triangles = t, a->nodes = n, a->layers = a->rim = a->near = 0;
  int64_t done = 0;
  for (int64_t i = 0; i < S; i++) {
    if (!there[i] || part[i] >= 0) continue;
    int64_t first = 0, last = 0, deepest = 0;
    queue[last++] = i, part[i] = i;
    for (; first < last; first++)
      for (int64_t j = 0; j < s->most_near; j++) {
        int64_t next = s->neighbours[queue[first] * s->most_near + j];
        if (next < S && there[next] && part[next] < 0) part[next] = i, queue[last++] = next;
      }
    for (int64_t j = 0; j < last; j++)
      if (depth[queue[j]] > deepest) deepest = depth[queue[j]];
    for (int64_t d = 0; d <= deepest; d++) {
      a->start[a->layers] = done;
      for (int64_t j = 0; j < last; j++)
        if (depth[queue[j]] == d) {
          a->depth[done] = d, a->layer[done] = a->layers, a->node[done] = queue[j];
          a->rim += d == 0, a->near += d <= 1;
          place[queue[j]] = done++;
        }
      a->layers++;
    }
  }
  a->start[a->layers] = done;
  for (int64_t i = 0; i < t && done == n; i++)
    for (int c = 0; c < 3; c++)
      a->corner[3 * i + c] = place[s->corner_support[3 * a->triangle[i] + c]];
  free(place), free(hit);
  return done == n ? 0 : 1; /* an area without a rim: on no sheet is there one */
}

/* What the bare areas' law makes of potentials: `bare` (rim, width), columns, is the law on the rims
 * times `both` (near, width). Returns -1 without memory. */
int apply_rim_law(const Sheet *s, const Areas *a, int64_t width, const double *both,
                   double *bare) {
  int64_t rim = 0, near = 0;
  int64_t *row = malloc(sizeof(int64_t) * 2 * (a->nodes + 1)), *column = row + a->nodes;
  double *law = calloc(a->rim * a->near + 1, sizeof(double)); /* columns (near, rim) */
  if (!row || !law) {
    free(row), free(law);
    return -1;
  }
  for (int64_t i = 0; i < a->nodes; i++) {
    row[i] = a->depth[i] == 0 ? rim++ : -1;
    column[i] = a->depth[i] <= 1 ? near++ : -1;
  }
  for (int64_t i = 0; i < a->triangles; i++) {
    int64_t t = a->triangle[i];
    const int64_t *corner = a->corner + 3 * i;
    for (int c = 0; c < 3; c++)
      if (row[corner[c]] >= 0)
        for (int d = 0; d < 3; d++)
          law[row[corner[c]] * near + column[corner[d]]] +=
              s->conductivity[t] * s->stiffness[9 * t + 3 * c + d];
  }
  multiply('T', 'T', rim, width, near, 1.0, law, near, both, width, 0.0, bare, rim);
  free(law), free(row);
  return 0;
}

/* Conductivity of a triangle as its corners have it, and whether none is worse than at rest. */
static int at_corners(const Sheet *s, int64_t t, const double *change, double sigma[3]) {
  int better = 1;
  for (int c = 0; c < 3; c++) {
    int64_t p = s->corner_pressable[3 * t + c];
    double by = p < 0 ? 0.0 : change[p];
    sigma[c] = s->conductivity[t] + by;
    better &= sigma[c] >= s->conductivity[t];
  }
  return better;
}

/* Solve for a pressed sheet; see `ForwardModel.solve`.
 *
 * change: (pressable,). green: (rim, rim). both: (rim, rim + fields), G and u0 side by side.
 * bare: (rim, rim + fields), columns. Out: voltages, potentials (nodes, fields) and injected
 * (rim, fields), columns. Returns 1 where a conductivity is not above 0, -1 without memory.
 */
int solve(const Sheet *s, const Areas *a, int mixes_resistivities, const double *change,
          const double *both, const double *bare, double *voltages, double *potentials,
          double *injected) {
  int F = s->fields, r = a->rim, width = r + F, failed = 0;
  int64_t total = 0, i, l;
  int64_t *offset = malloc(sizeof(int64_t) * (a->layers + 1));
  for (l = 0; offset && l < a->layers; l++) {
    int64_t size = a->start[l + 1] - a->start[l];
    int64_t outer = a->depth[a->start[l]] ? a->start[l] - a->start[l - 1] : 0;
    offset[l] = total, total += (outer + size) * size;
  }
  /* Of each layer its coupling (outer, size) with the next one outwards, and its own block. */
  double *flat = calloc(total + 1, sizeof(double));
  double *added = malloc(sizeof(double) * (width * r + F * F + 1));
  double *moved = added + width * r;
  int *pivots = malloc(sizeof(int) * (r + 1));
  if (!offset || !flat || !added || !pivots) {
    free(offset), free(flat), free(added), free(pivots);
    return -1;
  }
  for (i = 0; i < a->triangles; i++) {
    int64_t t = a->triangle[i];
    const int64_t *corner = a->corner + 3 * i;
    double c[3], sigma;
    int better = at_corners(s, t, change, c);
    if (mixes_resistivities && better)
      sigma = 3 / (1 / c[0] + 1 / c[1] + 1 / c[2]);
    else
      sigma = (c[0] + c[1] + c[2]) / 3;
    for (int m = 0; m < 3; m++)
      for (int n = 0; n < 3; n++) {
        int64_t row = a->layer[corner[m]], col = a->layer[corner[n]];
        if (row > col) continue;
        int64_t size = a->start[col + 1] - a->start[col];
        int64_t outer = a->depth[corner[n]] ? a->start[col] - a->start[col - 1] : 0;
        int64_t place = corner[m] - a->start[row] + (row == col ? outer : 0);
        flat[offset[col] + place * size + corner[n] - a->start[col]] +=
            sigma * s->stiffness[9 * t + 3 * m + n];
      }
  }
  /* Eliminate layer by layer outwards; W = L^-1 E^T takes the place of the coupling. */
  for (l = a->layers - 1; l >= 0 && !failed; l--) {
    if (a->depth[a->start[l]] == 0) continue;
    int size = a->start[l + 1] - a->start[l], outer = a->start[l] - a->start[l - 1], above = 0;
    double *E = flat + offset[l], *own = E + outer * size, one = 1.0;
    dpotrf("L", &size, own, &size, &failed);
    if (failed) break;
    dtrsm("L", "L", "N", "N", &size, &outer, &one, own, &size, E, &size);
    if (a->depth[a->start[l - 1]]) above = a->start[l - 1] - a->start[l - 2];
    multiply('T', 'N', outer, outer, size, -1.0, E, size, E, size, 1.0,
             flat + offset[l - 1] + above * outer, outer);
  }
  /* The rims: (1 + (S - S0) G) i = -(S - S0) u0. */
  int first = 0;
  for (l = 0; l < a->layers && !failed; l++) {
    if (a->depth[a->start[l]]) continue;
    int size = a->start[l + 1] - a->start[l];
    multiply('N', 'T', size, width, size, 1.0, flat + offset[l], size, both + first * width, width,
             0.0, added + first, r);
    first += size;
  }
  if (!failed) {
    for (i = 0; i < r * r; i++) added[i] -= bare[i];
    for (i = 0; i < r; i++) added[i * r + i] += 1.0;
    for (i = 0; i < r * F; i++) injected[i] = bare[r * r + i] - added[r * r + i];
    dgesv(&r, &F, added, &r, pivots, injected, &r, &failed);
  }
  if (!failed) {
    /* moved = u0^T i, by which the electrodes' potentials differ. */
    multiply('N', 'N', F, F, r, 1.0, both + r, width, injected, r, 0.0, moved, F);
    for (int64_t v = 0; v < s->voltages; v++) {
      const int64_t *e = s->electrodes + 4 * v;
      double each[2];
      for (int d = 0; d < 2; d++) {
        double at[2];
        for (int m = 0; m < 2; m++) {
          at[m] = s->transfer[e[2 + m] * (F + 1) + e[d]];
          if (e[2 + m] < F && e[d] < F) at[m] += moved[e[d] * F + e[2 + m]];
        }
        each[d] = at[0] - at[1];
      }
      voltages[v] = each[0] - each[1];
    }
    /* Potentials on the rims, u0 + G i, and from there inwards. */
    first = 0;
    for (l = 0; l < a->layers; l++) {
      int size = a->start[l + 1] - a->start[l];
      double *of = potentials + a->start[l] * F;
      if (a->depth[a->start[l]] == 0) {
        for (i = 0; i < size; i++) memcpy(of + i * F, both + (first + i) * width + r, 8 * F);
        multiply('T', 'N', F, size, r, 1.0, injected, r, both + first * width, width, 1.0, of, F);
        first += size;
      } else {
        int outer = a->start[l] - a->start[l - 1];
        double *W = flat + offset[l], minus = -1.0;
        multiply('N', 'T', F, size, outer, 1.0, potentials + a->start[l - 1] * F, F, W, size, 0.0,
                 of, F);
        dtrsm("R", "L", "N", "N", &F, &size, &minus, W + outer * size, &size, of, &F);
      }
    }
  }
  free(offset), free(flat), free(added), free(pivots);
  return failed ? 1 : 0;
}

/* Derivative of the voltages by parameters; see `ForwardModel.jacobian`.
 *
 * potentials: (nodes, fields). mixed: (pressable,) changes whose resistivities were mixed, or NULL.
 * place: (pressable,) row of each node in `onto` (n, count), -1 elsewhere. Out: (voltages, count).
 */
int differentiate(const Sheet *s, const Areas *a, const double *potentials, const double *mixed,
                  const int64_t *place, int64_t count, const double *onto, double *jacobian) {
  enum { STRIP = 64 }; /* triangles at once: what that takes stays in the cache */
  int P = s->pairs, Q = s->products, K = count, F = s->fields;
  double *fields = malloc(sizeof(double) * (a->nodes * P + STRIP * (Q + K) + 2 * P + Q * K));
  if (!fields) return -1;
  double *product = fields + a->nodes * P, *weight = product + STRIP * Q;
  double *x = weight + STRIP * K, *y = x + P, *summed = y + P;
  for (int64_t i = 0; i < a->nodes; i++)
    for (int p = 0; p < P; p++) {
      int64_t one = s->pair[2 * p], other = s->pair[2 * p + 1]; /* the last electrode is at 0 */
      const double *u = potentials + i * F;
      fields[i * P + p] = (one < F ? u[one] : 0.0) - (other < F ? u[other] : 0.0);
    }
  for (int64_t begin = 0; begin < a->triangles; begin += STRIP) {
    int strip = a->triangles - begin < STRIP ? a->triangles - begin : STRIP;
    for (int i = 0; i < strip; i++) {
      int64_t t = a->triangle[begin + i];
      const int64_t *corner = a->corner + 3 * (begin + i);
      const double *g = s->gradient + 6 * t;
      const double *u = fields + corner[0] * P, *v = fields + corner[1] * P;
      const double *w = fields + corner[2] * P;
      for (int p = 0; p < P; p++) {
        x[p] = g[0] * u[p] + g[1] * v[p] + g[2] * w[p];
        y[p] = g[3] * u[p] + g[4] * v[p] + g[5] * w[p];
      }
      double *of = product + i * Q;
      for (int q = 0; q < Q; q++) {
        int64_t one = s->product[2 * q], other = s->product[2 * q + 1];
        of[q] = x[one] * x[other] + y[one] * y[other];
      }
      /* Minus the area that goes with each corner; where resistivities were mixed
       * d sigma / d sigma_c = (sigma / sigma_c)^2 / 3. */
      double share[3] = {1.0, 1.0, 1.0}, c[3];
      if (mixed && at_corners(s, t, mixed, c)) {
        double mean = (1 / c[0] + 1 / c[1] + 1 / c[2]) / 3;
        for (int k = 0; k < 3; k++) share[k] = 1 / (c[k] * c[k] * mean * mean);
      }
      for (int k = 0; k < K; k++) weight[i * K + k] = 0.0;
      for (int k = 0; k < 3; k++) {
        int64_t p = s->corner_pressable[3 * t + k];
        if (p < 0 || place[p] < 0) continue;
        double by = -share[k] * s->area[t] / 3;
        const double *row = onto + place[p] * K;
        for (int j = 0; j < K; j++) weight[i * K + j] += by * row[j];
      }
    }
    multiply('N', 'T', K, Q, strip, 1.0, weight, K, product, Q, begin ? 1.0 : 0.0, summed, K);
  }
  for (int64_t v = 0; v < s->voltages; v++)
    for (int k = 0; k < K; k++)
      jacobian[v * K + k] = a->triangles ? summed[s->product_of[v] * K + k] * s->sign[v] : 0.0;
  free(fields);
  return 0;
}

/* Contacts: the columns of their parameters, and constants, as in `scene.pressure_field`. */
enum { X, Y, SIZE, E1, E2, HARMONIC, PEAK = 9, EDGE, HOLE, COLUMNS };
static const double UNIT_M = 0.01, NOWHERE = 1e-6, GRADED_WIDTH = 0.7, RIM = 0.1;
static const double MOST_BLURRED = 0.4;
static const double PI = 3.14159265358979323846;

typedef struct {
  double half_width_m, offset_m, unit_kpa, blur_m2;
  int64_t forms;    /* columns of the form that any contact has: 3, 5 or 9 */
  int64_t is_sharp; /* outlines as sharp as the points can show them */
} Field;

typedef struct {
  const double *each; /* (COLUMNS,) its parameters */
  double size;        /* the logarithm of its radius: less where it is the rim of a hole */
  double B[2][2], dB[3][2][2];
} Contact;

/* One contact and its hole as they are, and as they are drawn on a graded sheet: smaller, and stronger,
 * for the mesh's blur; how the logarithm of that size goes by that of its own, over 1, and by gamma. */
typedef struct {
  Contact as_is, hole, smaller, smaller_hole;
  double stronger, by_size, by_edge;
} Sizes;

/* An outline at a point: t = phi / w, log q, and their derivatives by the form. */
typedef struct {
  double t, log_q, by_t[PEAK], by_log_q[PEAK];
} Outline;

static Contact contact_of(const double *each, double size) {
  Contact c = {.each = each, .size = size};
  double of[2][2][2] = {{{1, 0}, {0, -1}}, {{0, 1}, {1, 0}}};
  double e1 = each[E1], e2 = each[E2], e = fmax(hypot(e1, e2), 1e-6), shrink = exp(-size);
  double ratio = sinh(e) / e, bend = e < 1e-3 ? 1.0 / 3 : (cosh(e) - ratio) / (e * e);
  for (int i = 0; i < 2; i++)
    for (int j = 0; j < 2; j++) {
      double E = e1 * of[0][i][j] + e2 * of[1][i][j], one = i == j;
      double common = ratio * one - bend * E;
      c.B[i][j] = shrink * (cosh(e) * one - ratio * E);
      c.dB[0][i][j] = -c.B[i][j];
      c.dB[1][i][j] = shrink * (e1 * common - ratio * of[0][i][j]);
      c.dB[2][i][j] = shrink * (e2 * common - ratio * of[1][i][j]);
    }
  return c;
}

static Sizes sizes_of(const Field *f, const double *each) {
  double moment = 2 * (each[EDGE] + 2), blur = moment * f->blur_m2 * exp(-2 * each[SIZE]);
  double held = tanh(blur / MOST_BLURRED), left = 1 - MOST_BLURRED * held;
  double size = each[SIZE] + log(left) / 2, by_size = blur * (1 - held * held) / left;
  return (Sizes){.as_is = contact_of(each, each[SIZE]),
                    .hole = contact_of(each, each[SIZE] - log(2)),
                    .smaller = contact_of(each, size),
                    .smaller_hole = contact_of(each, size - log(2)),
                    .stronger = 1 / left,
                    .by_size = by_size,
                    .by_edge = -by_size / moment};
}

static Outline outline_at(const Field *f, const Contact *c, double x, double y, int with_slopes) {
  Outline o;
  double r[2] = {x - UNIT_M * c->each[X], y - UNIT_M * c->each[Y]}, u[2], v[2], wave[4];
  for (int i = 0; i < 2; i++) u[i] = c->B[i][0] * r[0] + c->B[i][1] * r[1];
  if (fmax(fabs(u[0]), fabs(u[1])) < NOWHERE) u[0] += NOWHERE; /* any direction will do */
  for (int i = 0; i < 2; i++) v[i] = c->B[i][0] * u[0] + c->B[i][1] * u[1];
  double square = u[0] * u[0] + u[1] * u[1], length2 = v[0] * v[0] + v[1] * v[1];
  double scale = square / sqrt(length2), turn = 0.0;
  o.log_q = 0.5 * log(square);
  if (f->forms == PEAK) {
    double psi = atan2(u[1], u[0]);
    for (int k = 0; k < 2; k++) {
      double a = c->each[HARMONIC + 2 * k], b = c->each[HARMONIC + 2 * k + 1];
      double cosine = cos((3 + k) * psi), sine = sin((3 + k) * psi);
      wave[2 * k] = cosine, wave[2 * k + 1] = sine;
      turn += (3 + k) * (b * cosine - a * sine);
      o.log_q -= a * cosine + b * sine;
    }
  }
  double inner = exp(fmax(-1 - o.log_q, 0.0)), depth = o.log_q > -1 ? -o.log_q : inner;
  o.t = depth * scale / f->half_width_m;
  if (!with_slopes) return o;
  double by_depth = -inner * scale;
  for (int p = 0; p < f->forms; p++) {
    double by_scale = 0.0;
    if (p < HARMONIC) {
      double du[2], dv[2];
      for (int i = 0; i < 2; i++)
        du[i] = p < SIZE ? -UNIT_M * c->B[i][p]
                         : c->dB[p - SIZE][i][0] * r[0] + c->dB[p - SIZE][i][1] * r[1];
      for (int i = 0; i < 2; i++) {
        dv[i] = c->B[i][0] * du[0] + c->B[i][1] * du[1];
        if (p >= SIZE) dv[i] += c->dB[p - SIZE][i][0] * u[0] + c->dB[p - SIZE][i][1] * u[1];
      }
      double radial = u[0] * du[0] + u[1] * du[1], along = v[0] * dv[0] + v[1] * dv[1];
      o.by_log_q[p] = (radial - turn * (u[0] * du[1] - u[1] * du[0])) / square;
      by_scale = scale * (2 * radial / square - along / length2);
    } else {
      o.by_log_q[p] = -wave[p - HARMONIC];
    }
    o.by_t[p] = (o.by_log_q[p] * by_depth + depth * by_scale) / f->half_width_m;
  }
  return o;
}

static double step(const Field *f, double t) {
  if (f->is_sharp) return fmin(fmax(0.5 + t, 0.0), 1.0);
  if (t <= -1) return 0.0;
  t = fmin(t, 1.0);
  return 0.5 * (1 + t + sin(PI * t) / PI);
}

static double step_slope(double t) { return (1 + cos(PI * fmin(fmax(t, -1.0), 1.0))) / 2; }

/* What one contact, of one size, does at a point. */
typedef struct {
  Outline outline, hole;
  double whole, left, share, fall, root, rim, depth, profile, pressure;
} Pressed;

/* The same of a contact as it is, and as it is drawn on a graded sheet. */
typedef struct {
  Pressed as_is, drawn;
  double wide, enclosed;
} Press;

static void press_by(const Field *f, const Contact *c, const Contact *hole, double x, double y,
                     int with_slopes, Pressed *p) {
  p->whole = step(f, p->outline.t / GRADED_WIDTH), p->left = 1.0;
  if (hole) {
    p->hole = outline_at(f, hole, x, y, with_slopes);
    p->left -= c->each[HOLE] * step(f, p->hole.t);
  }
  p->share = p->whole * p->left;
  p->rim = RIM * f->half_width_m * exp(-c->size);
  p->fall = 1 - exp(2 * fmin(p->outline.log_q, 1.0));
  p->root = sqrt(p->fall * p->fall + 4 * p->rim * p->rim);
  p->depth = 0.5 * (p->fall + p->root);
  p->profile = c->each[EDGE] == 0 ? 1.0 : pow(p->depth, c->each[EDGE]);
  p->pressure = f->unit_kpa * c->each[PEAK] * p->profile;
}

/* Whether a contact reaches a point, and what it does there. */
static int press(const Field *f, const Sizes *c, int is_ring, double x, double y,
                 int with_slopes, Press *p) {
  p->as_is.outline = outline_at(f, &c->as_is, x, y, with_slopes);
  p->wide = p->as_is.outline.t + f->offset_m / f->half_width_m;
  if (p->wide <= -1) return 0;
  p->enclosed = step(f, p->wide);
  press_by(f, &c->as_is, is_ring ? &c->hole : NULL, x, y, with_slopes, &p->as_is);
  if (f->is_sharp) { /* no mesh that blurs */
    p->drawn = p->as_is;
    return 1;
  }
  p->drawn.outline = outline_at(f, &c->smaller, x, y, with_slopes);
  press_by(f, &c->smaller, is_ring ? &c->smaller_hole : NULL, x, y, with_slopes, &p->drawn);
  return 1;
}

/* Derivatives of share and pressure, by all parameters: by the size that is drawn. */
static void by_parameters(const Field *f, const double *c, const Pressed *p, int is_ring,
                          double *share, double *pressure) {
  double edge = c[EDGE], by_depth = 0.0, by_q = 0.0, away = 0.0;
  double by_whole = step_slope(p->outline.t / GRADED_WIDTH) / GRADED_WIDTH * p->left;
  if (c[HOLE] != 0) away = c[HOLE] * p->whole * step_slope(p->hole.t);
  if (edge != 0) {
    by_depth = f->unit_kpa * c[PEAK] * edge * p->profile / p->depth;
    if (p->outline.log_q < 1.0)
      by_q = by_depth * 0.5 * (1 + p->fall / p->root) * -2 * (1 - p->fall);
  }
  memset(share, 0, sizeof(double) * COLUMNS), memset(pressure, 0, sizeof(double) * COLUMNS);
  for (int q = 0; q < f->forms; q++) {
    share[q] = by_whole * p->outline.by_t[q];
    if (away != 0) share[q] -= away * p->hole.by_t[q];
    pressure[q] = by_q * p->outline.by_log_q[q];
  }
  pressure[SIZE] -= by_depth * 2 * p->rim * p->rim / p->root;
  pressure[PEAK] = f->unit_kpa * p->profile;
  pressure[EDGE] = p->pressure * log(p->depth);
  if (is_ring) share[HOLE] = -p->whole * step(f, p->hole.t);
}

/* Draw contacts (count, COLUMNS) at points (n,); see `PressureField.draw` and `sampled`.
 *
 * Out, for each point that a contact reaches, or for all where `points` is NULL: which it is, the
 * share enclosed (all of it within sharp outlines) and the pressure there, the share pressed and the
 * pressure as drawn on a graded sheet. Returns how many, -1 without memory.
 */
int64_t draw(const Field *f, int64_t count, const double *each, int64_t n, const double *x,
             const double *y, int64_t *points, double *enclosed, double *enclosed_kpa,
             double *share, double *pressure) {
  Sizes *contact = malloc(sizeof(Sizes) * (count + 1));
  double *reach2 = malloc(sizeof(double) * (count + 1));
  if (!contact || !reach2) {
    free(contact), free(reach2);
    return -1;
  }
  for (int64_t k = 0; k < count; k++) {
    const double *c = each + COLUMNS * k;
    contact[k] = sizes_of(f, c);
    double longest = c[SIZE] + hypot(c[E1], c[E2]);
    for (int h = HARMONIC; h < PEAK; h++) longest += fabs(c[h]);
    double reach = exp(longest) + 2 * (f->half_width_m + f->offset_m);
    reach2[k] = reach * reach;
  }
  int64_t there = 0;
  for (int64_t i = 0; i < n; i++) {
    double no_wide = 1.0, no_share = 1.0, stronger = 0.0;
    double of_as_is = 0.0, as_is = 0.0, of_drawn = 0.0, drawn = 0.0;
    int hit = 0;
    for (int64_t k = 0; k < count; k++) {
      const double *c = each + COLUMNS * k;
      double dx = x[i] - UNIT_M * c[X], dy = y[i] - UNIT_M * c[Y];
      Press p;
      if (dx * dx + dy * dy >= reach2[k]) continue;
      if (!press(f, contact + k, c[HOLE] != 0, x[i], y[i], 0, &p)) continue;
      hit = 1;
      no_wide *= 1 - (f->is_sharp ? p.as_is.whole : p.enclosed), no_share *= 1 - p.drawn.share;
      of_as_is += p.as_is.share, as_is += p.as_is.share * p.as_is.pressure;
      of_drawn += p.drawn.share, drawn += p.drawn.share * p.drawn.pressure;
      stronger += p.drawn.share * contact[k].stronger;
    }
    if (points && !hit) continue;
    if (points) points[there] = i;
    of_as_is = fmax(of_as_is, 1e-12), of_drawn = fmax(of_drawn, 1e-12);
    enclosed[there] = 1 - no_wide, enclosed_kpa[there] = as_is / of_as_is;
    share[there] = (1 - no_share) * stronger / of_drawn, pressure[there++] = drawn / of_drawn;
  }
  free(contact), free(reach2);
  return there;
}

/* Derivatives of what `draw` gives, by the parameters that are free; see `_Contacts.slopes`.
 *
 * index: (count, COLUMNS) place of each among `free` parameters, -1 where it is fixed. Out: four of
 * (n, parameters). Returns -1 without memory.
 */
int draw_slopes(const Field *f, int64_t count, const double *each, int64_t n, const double *x,
                const double *y, const int64_t *index, int64_t parameters, double *by_enclosed,
                double *by_enclosed_kpa, double *by_share, double *by_pressure) {
  Sizes *contact = malloc(sizeof(Sizes) * (count + 1));
  Press *pressed = malloc(sizeof(Press) * (count + 1));
  int64_t *of = malloc(sizeof(int64_t) * (count + 1));
  if (!contact || !pressed || !of) {
    free(contact), free(pressed), free(of);
    return -1;
  }
  for (int64_t k = 0; k < count; k++) contact[k] = sizes_of(f, each + COLUMNS * k);
  size_t size = sizeof(double) * n * parameters;
  memset(by_enclosed, 0, size), memset(by_enclosed_kpa, 0, size);
  memset(by_share, 0, size), memset(by_pressure, 0, size);
  for (int64_t i = 0; i < n; i++) {
    int there = 0;
    double of_as_is = 0.0, as_is = 0.0, of_drawn = 0.0, drawn = 0.0, stronger = 0.0;
    double no_share = 1.0;
    for (int64_t k = 0; k < count; k++) {
      int is_ring = each[COLUMNS * k + HOLE] != 0 || index[COLUMNS * k + HOLE] >= 0;
      Press *p = pressed + there;
      if (!press(f, contact + k, is_ring, x[i], y[i], 1, p)) continue;
      of_as_is += p->as_is.share, as_is += p->as_is.share * p->as_is.pressure;
      of_drawn += p->drawn.share, drawn += p->drawn.share * p->drawn.pressure;
      stronger += p->drawn.share * contact[k].stronger, no_share *= 1 - p->drawn.share;
      of[there++] = k;
    }
    of_as_is = fmax(of_as_is, 1e-12), as_is /= of_as_is;
    of_drawn = fmax(of_drawn, 1e-12), drawn /= of_drawn, stronger /= of_drawn;
    for (int j = 0; j < there; j++) {
      const Press *p = pressed + j;
      const Sizes *sizes = contact + of[j];
      const double *c = each + COLUMNS * of[j];
      const int64_t *places = index + COLUMNS * of[j];
      double others_wide = 1.0, others_share = 1.0; /* what is pressed twice is pressed once */
      for (int o = 0; o < there; o++)
        if (o != j) others_wide *= 1 - pressed[o].enclosed, others_share *= 1 - pressed[o].drawn.share;
      double by_wide = step_slope(p->wide), own[2][COLUMNS], share[COLUMNS], kpa[COLUMNS];
      int is_ring = c[HOLE] != 0 || places[HOLE] >= 0;
      by_parameters(f, c, &p->as_is, is_ring, own[0], own[1]);
      by_parameters(f, c, &p->drawn, is_ring, share, kpa);
      share[EDGE] = sizes->by_edge * share[SIZE], share[SIZE] += sizes->by_size * share[SIZE];
      kpa[EDGE] += sizes->by_edge * kpa[SIZE], kpa[SIZE] += sizes->by_size * kpa[SIZE];
      for (int q = 0; q < COLUMNS; q++) {
        if (places[q] < 0) continue;
        int64_t at = i * parameters + places[q];
        double by = q == SIZE ? sizes->by_size : q == EDGE ? sizes->by_edge : 0.0;
        double strength = share[q] * (sizes->stronger - stronger) -
                          2 * by * sizes->stronger * p->drawn.share;
        by_enclosed[at] = q < f->forms ? by_wide * p->as_is.outline.by_t[q] * others_wide : 0.0;
        by_enclosed_kpa[at] =
            (own[0][q] * (p->as_is.pressure - as_is) + own[1][q] * p->as_is.share) / of_as_is;
        by_share[at] = share[q] * others_share * stronger + (1 - no_share) * strength / of_drawn;
        by_pressure[at] =
            (share[q] * (p->drawn.pressure - drawn) + kpa[q] * p->drawn.share) / of_drawn;
      }
    }
  }
  free(contact), free(pressed), free(of);
  return 0;
}
