/* The inner loop of the pressure field's fit: contacts drawn on the mesh, what they make each sheet
 * conduct, the pressed sheet solved, its voltages compared with the data and differentiated. The
 * theory and its sources stand in `scene.pressure_field`, `scene.sheet_response` and
 * `physics.forward`. `inner_loop.py` loads it.
 *
 * Matrices are row-major unless their comment says columns: then an (r, c) matrix has its r entries
 * of a column side by side, as BLAS has it. Nothing here reads or writes but the arrays given.
 * Functions return 0, -1 without memory, and what they say besides.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#ifndef SOURCE
#define SOURCE "" /* compiled by hand */
#endif
const char source[65] = SOURCE; /* SHA-256 of this file: `inner_loop.py` loads no other one */

/* SciPy's BLAS and LAPACK, whose addresses Python gives. */
static void (*dgemm)(char *, char *, int *, int *, int *, double *, double *, int *, double *,
                     int *, double *, double *, int *);
static void (*dtrsm)(char *, char *, char *, char *, int *, int *, double *, double *, int *,
                     double *, int *);
static void (*dpotrf)(char *, int *, double *, int *, int *);
static void (*dgetrf)(int *, int *, double *, int *, int *, int *);
static void (*dgetrs)(char *, int *, int *, double *, int *, int *, double *, int *, int *);

void use_blas(void *gemm, void *trsm, void *potrf, void *getrf, void *getrs) {
  dgemm = gemm, dtrsm = trsm, dpotrf = potrf, dgetrf = getrf, dgetrs = getrs;
}

enum { UNSOLVABLE = 1 }; /* what else a function may return */

/* C (m, n) = alpha op(A) op(B) + beta C, all columns. */
static void multiply(char ta, char tb, int m, int n, int k, double alpha, const double *A, int lda,
                     const double *B, int ldb, double beta, double *C, int ldc) {
  int of_a = lda ? lda : 1, of_b = ldb ? ldb : 1; /* of nothing BLAS asks the same */
  if (m && n)
    dgemm(&ta, &tb, &m, &n, &k, &alpha, (double *)A, &of_a, (double *)B, &of_b, &beta, C, &ldc);
}

/* What of a sheet stays the same; see `ForwardModel`. */
typedef struct {
  int64_t triangles, support, pressable, fields, pairs, products, voltages;
  int64_t most_around, most_near; /* columns of triangles_of, of neighbours */
  const int64_t *corner_support;   /* (triangles, 3) */
  const int64_t *corner_pressable; /* (triangles, 3), -1 elsewhere */
  const int64_t *triangles_of;     /* (pressable, most_around), filled up with `triangles` */
  const int64_t *neighbours;       /* (support, most_near), itself too, filled up with `support` */
  const int64_t *triangle_count;   /* (support,) */
  const uint8_t *closed;           /* (support,) */
  const double *gradient;          /* (triangles, 2, 3) */
  const double *stiffness;         /* (triangles, 3, 3) */
  const double *area;              /* (triangles,) */
  const double *conductivity;      /* (triangles,) of the bare sheet */
  const double *at_rest;           /* (pressable,) of the bare sheet */
  const double *potentials;        /* (support, fields) of the bare sheet */
  const double *transfer;          /* (fields + 1, fields + 1) of the bare sheet */
  const double *bare_voltages;     /* (voltages,) */
  const int64_t *electrodes;       /* (voltages, 4): source, sink, v+, v- */
  const int64_t *pair;             /* (pairs, 2): field that counts, field that is taken off */
  const int64_t *product;          /* (products, 2): the pairs of each */
  const int64_t *product_of;       /* (voltages,) */
  const double *sign;              /* (voltages,) */
  const float *green_single;       /* (support (support + 1) / 2,) lower triangle of the Green's */
  const double *green_double;      /* function, in the precision that it has; else NULL */
} Sheet;

/* The areas around pressed nodes; (t,) triangles, (n,) nodes. */
typedef struct {
  int64_t triangles, nodes, layers, rim;
  int64_t is_known;  /* whether `both` and `rest` are filled */
  int64_t *triangle; /* (t,) area by area */
  int64_t *corner;   /* (t, 3) places among the nodes */
  int64_t *node;     /* (n,) positions in the support, area by area, layer by layer inwards */
  int64_t *start;    /* (layers + 1,) */
  int64_t *depth;    /* (n,) */
  int64_t *layer;    /* (n,) */
  double *both;      /* (rim, rim + fields), G and u0 side by side */
  double *rest;      /* (rim, rim) at most: of each bare area the stiffness (size, size) condensed
                      * onto its rim, one after the other */
} Areas;

/* Find the areas around nodes (count,); buffers of `areas` are large enough for any. Returns
 * UNSOLVABLE where an area has no rim (on no sheet is there one). */
int find_areas(const Sheet *s, int64_t count, const int64_t *where, Areas *a) {
  int64_t S = s->support, T = s->triangles, n = 0;
  int64_t *place = malloc(sizeof(int64_t) * (5 * S + 2));
  uint8_t *hit = calloc(T + 1 + S, 1);
  if (!place || !hit) {
    free(place), free(hit);
    return -1;
  }
  int64_t *here = place + S, *depth = here + S, *part = depth + S, *queue = part + S;
  uint8_t *there = hit + T + 1;
  memset(here, 0, sizeof(int64_t) * S);
  for (int64_t i = 0; i < count; i++)
    for (int64_t j = 0; j < s->most_around; j++) {
      int64_t t = s->triangles_of[where[i] * s->most_around + j];
      if (t == T || hit[t]) continue;
      hit[t] = 1;
      for (int c = 0; c < 3; c++) {
        int64_t node = s->corner_support[3 * t + c];
        there[node] = 1, here[node]++;
      }
    }
  /* Depths from all rims at once. */
  int64_t head = 0, tail = 0;
  for (int64_t i = 0; i < S; i++) {
    if (!there[i]) continue;
    depth[i] = part[i] = -1, n++;
    if (!s->closed[i] || here[i] < s->triangle_count[i]) depth[i] = 0, queue[tail++] = i;
  }
  for (; head < tail; head++)
    for (int64_t j = 0; j < s->most_near; j++) {
      int64_t next = s->neighbours[queue[head] * s->most_near + j];
      if (next < S && there[next] && depth[next] < 0)
        depth[next] = depth[queue[head]] + 1, queue[tail++] = next;
    }
  /* Connected parts; within each its triangles, and its nodes by depth. */
  a->nodes = n, a->triangles = a->layers = a->rim = a->is_known = 0;
  int64_t done = 0, areas = 0;
  for (int64_t i = 0; i < S; i++) {
    if (!there[i] || part[i] >= 0) continue;
    int64_t first = 0, last = 0, deepest = 0;
    queue[last++] = i, part[i] = areas++;
    for (; first < last; first++)
      for (int64_t j = 0; j < s->most_near; j++) {
        int64_t next = s->neighbours[queue[first] * s->most_near + j];
        if (next < S && there[next] && part[next] < 0) part[next] = part[i], queue[last++] = next;
      }
    for (int64_t j = 0; j < last; j++)
      if (depth[queue[j]] > deepest) deepest = depth[queue[j]];
    for (int64_t d = 0; d <= deepest; d++) {
      a->start[a->layers] = done;
      for (int64_t j = 0; j < last; j++)
        if (depth[queue[j]] == d) {
          a->depth[done] = d, a->layer[done] = a->layers, a->node[done] = queue[j];
          a->rim += d == 0;
          place[queue[j]] = done++;
        }
      a->layers++;
    }
  }
  a->start[a->layers] = done;
  int64_t *next_of = here; /* where each area's next triangle goes */
  memset(next_of, 0, sizeof(int64_t) * S);
  for (int64_t t = 0; t < T; t++)
    if (hit[t]) a->triangles++, next_of[part[s->corner_support[3 * t]]]++;
  for (int64_t i = areas - 1, end = a->triangles; i >= 0; i--) end -= next_of[i], next_of[i] = end;
  for (int64_t t = 0; t < T && done == n; t++) {
    if (!hit[t]) continue;
    int64_t i = next_of[part[s->corner_support[3 * t]]]++;
    a->triangle[i] = t;
    for (int c = 0; c < 3; c++) a->corner[3 * i + c] = place[s->corner_support[3 * t + c]];
  }
  free(place), free(hit);
  return done != n ? UNSOLVABLE : 0;
}

static const double LEAST = 0.01, ROUNDING = 1e-12; /* of a conductivity ratio; of a change */

/* Conductivity of a triangle, and its slopes by that of each corner: at rest its own, else by the
 * power mean of what its corners grew by; see `ForwardModel.solve`.
 *
 * change: (pressable,); NULL at rest. Not above 0 where a corner's is not.
 */
static double conductivity_of(const Sheet *s, int64_t t, double exponent, const double *change,
                              double by[3]) {
  double rest = s->conductivity[t], at_rest[3], grown[3], power[3];
  int better = 1, whole = 1;
  for (int k = 0; k < 3; k++) {
    int64_t p = s->corner_pressable[3 * t + k];
    double more = p < 0 || !change ? 0.0 : change[p];
    at_rest[k] = p < 0 ? rest : s->at_rest[p], grown[k] = (at_rest[k] + more) / at_rest[k];
    better &= more >= -ROUNDING * at_rest[k], whole &= grown[k] > 0;
  }
  if (exponent == 1) { /* the sheet's own law: linear in what its nodes conduct */
    double sigma = rest;
    for (int k = 0; k < 3; k++) sigma += (grown[k] - 1) * at_rest[k] / 3, by[k] = 1.0 / 3;
    return sigma;
  }
  if (!whole) return by[0] = by[1] = by[2] = 0.0;
  double p = better ? exponent : fabs(exponent), mean = 0.0, sigma = grown[0];
  if (grown[0] == grown[1] && grown[0] == grown[2]) { /* within a contact, and beside it */
    for (int k = 0; k < 3; k++) by[k] = rest / at_rest[k] / 3;
    return rest * sigma;
  }
  for (int k = 0; k < 3; k++) {
    power[k] = p == 0 ? log(grown[k]) : pow(grown[k], p);
    mean += power[k] / 3;
  }
  sigma = p == 0 ? exp(mean) : pow(mean, 1 / p);
  for (int k = 0; k < 3; k++) /* power[k] / mean: how much of the mean is that corner's */
    by[k] = rest * sigma / (3 * grown[k] * at_rest[k]) * (p == 0 ? 1.0 : power[k] / mean);
  return rest * sigma;
}

static int size_of(const Areas *a, int64_t layer) { return a->start[layer + 1] - a->start[layer]; }

/* How many nodes the next layer outwards has. */
static int outer_of(const Areas *a, int64_t layer) {
  return a->depth[a->start[layer]] ? size_of(a, layer - 1) : 0;
}

/* Areas condensed onto their rims. */
typedef struct {
  int64_t *offset; /* (layers,) */
  double *flat;    /* of each layer L^-1 E, E its coupling (outer, size) with the next one outwards,
                    * and L: on rims the stiffness (size, size) that is left */
} Condensed;

static void forget(Condensed *c) { free(c->offset), free(c->flat); }

/* Sum triangles into layers: see `Condensed.flat`. */
static void assemble(const Sheet *s, const Areas *a, double exponent, const double *change,
                     Condensed *c) {
  for (int64_t i = 0; i < a->triangles; i++) {
    int64_t t = a->triangle[i];
    const int64_t *corner = a->corner + 3 * i;
    double by[3], sigma = conductivity_of(s, t, exponent, change, by);
    for (int m = 0; m < 3; m++)
      for (int n = 0; n < 3; n++) {
        int64_t row = a->layer[corner[m]], col = a->layer[corner[n]];
        if (row > col) continue;
        int64_t place = corner[m] - a->start[row] + (row == col ? outer_of(a, col) : 0);
        c->flat[c->offset[col] + place * size_of(a, col) + corner[n] - a->start[col]] +=
            sigma * s->stiffness[9 * t + 3 * m + n];
      }
  }
}

/* Condense areas, layer by layer outwards. */
static int condense(const Sheet *s, const Areas *a, double exponent, const double *change,
                    Condensed *c) {
  int64_t total = 0;
  c->offset = malloc(sizeof(int64_t) * (a->layers + 1));
  for (int64_t l = 0; c->offset && l < a->layers; l++)
    c->offset[l] = total, total += (outer_of(a, l) + size_of(a, l)) * size_of(a, l);
  c->flat = calloc(total + 1, sizeof(double));
  if (!c->offset || !c->flat) {
    forget(c);
    return -1;
  }
  assemble(s, a, exponent, change, c);
  for (int64_t l = a->layers - 1; l >= 0; l--) {
    int size = size_of(a, l), outer = outer_of(a, l), failed = 0;
    if (!outer) continue;
    double *E = c->flat + c->offset[l], *own = E + outer * size, one = 1.0;
    dpotrf("L", &size, own, &size, &failed);
    if (failed) {
      forget(c);
      return UNSOLVABLE;
    }
    dtrsm("L", "L", "N", "N", &size, &outer, &one, own, &size, E, &size);
    multiply('T', 'N', outer, outer, size, -1.0, E, size, E, size, 1.0,
             c->flat + c->offset[l - 1] + outer_of(a, l - 1) * outer, outer);
  }
  return 0;
}

/* Place of an entry of a symmetric matrix in its lower triangle, row by row. */
static int64_t in_triangle(int64_t row, int64_t column) {
  int64_t more = row > column ? row : column;
  return more * (more + 1) / 2 + row + column - more;
}

/* An entry of such a matrix that is given in either precision. */
static double entry_of(const float *singles, const double *doubles, int64_t row, int64_t column) {
  int64_t place = in_triangle(row, column);
  return singles ? singles[place] : doubles[place];
}

/* A block (rows, count) of a symmetric matrix whose lower triangle is given in either precision:
 * what lies below the diagonal by its rows, then the rest by its columns, which are rows there. */
void block_of(const float *singles, const double *doubles, int64_t rows, const int64_t *row,
              int64_t count, const int64_t *column, double *found) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t k = 0; k < count; k++)
      if (column[k] <= row[i])
        found[i * count + k] = entry_of(singles, doubles, row[i], column[k]);
  for (int64_t k = 0; k < count; k++)
    for (int64_t i = 0; i < rows; i++)
      if (column[k] > row[i])
        found[i * count + k] = entry_of(singles, doubles, row[i], column[k]);
}

/* Fill in what areas know of the bare sheet: G and u0 at their rims, and their stiffness there.
 *
 * given: (rim, rim) of the Green's function, where the sheet has it in pieces; else NULL.
 */
static int know(const Sheet *s, const double *given, Areas *a) {
  int64_t r = a->rim, F = s->fields, width = r + F, first = 0;
  int64_t *node = malloc(sizeof(int64_t) * (r + 1));
  Condensed bare;
  int failed = node ? condense(s, a, 0, NULL, &bare) : -1;
  if (failed) {
    free(node);
    return failed;
  }
  double *rest = a->rest;
  for (int64_t l = 0; l < a->layers; l++) {
    if (a->depth[a->start[l]]) continue;
    int64_t size = size_of(a, l);
    memcpy(node + first, a->node + a->start[l], sizeof(int64_t) * size), first += size;
    memcpy(rest, bare.flat + bare.offset[l], sizeof(double) * size * size), rest += size * size;
  }
  for (int64_t i = 0; i < r; i++) {
    double *row = a->both + i * width;
    memcpy(row + r, s->potentials + node[i] * F, sizeof(double) * F);
    if (given) memcpy(row, given + i * r, sizeof(double) * r);
    for (int64_t j = 0; j < r && !given; j++) /* symmetric: looked up once, along its rows */
      if (node[j] <= node[i])
        row[j] = a->both[j * width + i] =
            entry_of(s->green_single, s->green_double, node[i], node[j]);
  }
  a->is_known = 1;
  free(node), forget(&bare);
  return 0;
}

/* What rims solve: (1 + (S - S0) G) i = -(S - S0) u0, with S and S0 condensed onto them. */
typedef struct {
  double *system; /* (rim, rim + fields): (S - S0) (G, u0); then factors of 1 + (S - S0) G, whose
                   * transpose has columns, in the first of each row */
  int *pivots;    /* (rim,) */
} Rims;

/* Set up what the rims of condensed areas solve, and factor it. */
static int factor(const Sheet *s, const Areas *a, const Condensed *c, Rims *rims) {
  int r = a->rim, width = r + s->fields, failed = 0, first = 0;
  const double *rest = a->rest;
  rims->system = malloc(sizeof(double) * (r * width + 1));
  rims->pivots = malloc(sizeof(int) * (r + 1));
  if (!rims->system || !rims->pivots) return -1;
  for (int64_t l = 0; l < a->layers; l++) {
    if (a->depth[a->start[l]]) continue;
    int size = size_of(a, l);
    double *left = c->flat + c->offset[l];
    for (int64_t i = 0; i < (int64_t)size * size; i++) left[i] -= rest[i];
    multiply('N', 'N', width, size, size, 1.0, a->both + first * width, width, left, size, 0.0,
             rims->system + first * width, width);
    first += size, rest += size * size;
  }
  for (int64_t i = 0; i < r; i++) rims->system[i * width + i] += 1.0;
  if (r) dgetrf(&r, &r, rims->system, &width, rims->pivots, &failed);
  return failed ? UNSOLVABLE : 0;
}

/* What is pressed on a sheet, and what becomes of it. */
typedef struct {
  int64_t count;
  const int64_t *where;    /* (count,) pressable nodes */
  const double *share;     /* (count,) pressed; NULL where `change` is given */
  const double *pressure;  /* (count,) kPa */
  double log_ratio, exponent;
  double *change;     /* (pressable,) conductivity minus the bare sheet's */
  double *voltages;   /* (voltages,) */
  double *residual;   /* (voltages,) weighted */
  double *potentials; /* (nodes, fields) */
  double *injected;   /* (rim, fields) columns */
} Pressing;

/* Voltages of the bare transfer resistances with `moved` (fields, fields), columns, added. */
static void scan(const Sheet *s, const double *moved, double *voltages) {
  int64_t F = s->fields;
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
}

/* Potentials on the rims, u0 + G i, and from there inwards. */
static void spread(const Sheet *s, const Areas *a, const Condensed *c, const double *injected,
                   double *potentials) {
  int F = s->fields, r = a->rim, width = r + F, first = 0;
  for (int64_t l = 0; l < a->layers; l++) {
    int size = size_of(a, l), outer = outer_of(a, l);
    double *of = potentials + a->start[l] * F, minus = -1.0;
    if (!outer) {
      for (int64_t i = 0; i < size; i++)
        memcpy(of + i * F, a->both + (first + i) * width + r, sizeof(double) * F);
      multiply('T', 'N', F, size, r, 1.0, injected, r, a->both + first * width, width, 1.0, of,
               F);
      first += size;
    } else {
      double *W = c->flat + c->offset[l];
      multiply('N', 'T', F, size, outer, 1.0, potentials + a->start[l - 1] * F, F, W, size, 0.0, of,
               F);
      dtrsm("R", "L", "N", "N", &F, &size, &minus, W + outer * size, &size, of, &F);
    }
  }
}

/* Currents (rim, fields), columns, that rims inject. */
static void inject(const Sheet *s, const Areas *a, const Rims *rims, double *injected) {
  int F = s->fields, r = a->rim, width = r + F, failed;
  for (int64_t i = 0; i < r; i++)
    for (int64_t m = 0; m < F; m++) injected[m * r + i] = -rims->system[i * width + r + m];
  if (r) dgetrs("T", &r, &F, rims->system, &width, rims->pivots, injected, &r, &failed);
}

/* Solve for a pressed sheet; see `ForwardModel.solve`. */
static int solve(const Sheet *s, const Areas *a, const Pressing *p) {
  int F = s->fields, r = a->rim, width = r + F;
  Condensed c;
  Rims rims = {NULL, NULL};
  int failed = condense(s, a, p->exponent, p->change, &c);
  if (failed) return failed;
  double *moved = malloc(sizeof(double) * F * F);
  failed = moved ? factor(s, a, &c, &rims) : -1;
  if (!failed) {
    inject(s, a, &rims, p->injected);
    /* u0^T i, by which the electrodes' potentials differ. */
    multiply('N', 'N', F, F, r, 1.0, a->both + r, width, p->injected, r, 0.0, moved, F);
    scan(s, moved, p->voltages);
    spread(s, a, &c, p->injected, p->potentials);
  }
  free(moved), free(rims.system), free(rims.pivots), forget(&c);
  return failed;
}

/* What a pressure does to a sheet: see `scene.sheet_response`. */
typedef struct {
  int64_t saturates, count;
  const double *pressure; /* (count,) kPa */
  const double *value;    /* (count,) relative change, or share of the full change's logarithm */
  double reflection;      /* what the outline of a typical contact reflects, from 0 to 1 */
} Response;

/* A table's value and slope; beyond its end either its last piece or its last value goes on. */
static double of_table(const Response *r, double pressure, double *slope) {
  int64_t i = 0, last = r->count - (r->saturates ? 1 : 2);
  const double *at = r->pressure, *value = r->value;
  while (i < last && at[i + 1] <= pressure) i++;
  *slope = i + 1 < r->count ? (value[i + 1] - value[i]) / (at[i + 1] - at[i]) : 0.0;
  if (r->saturates && pressure <= at[0]) return value[0];
  return value[i] + *slope * (pressure - at[i]);
}

/* Conductivity ratio of a node of which a share changes to the exponential of `log_full`, and its
 * slopes by both: the power mean whose exponent is what the outline reflects. */
static double blended(double reflection, double share, double log_full, double by[2]) {
  double k = -copysign(reflection, log_full);
  if (reflection < 1e-6) { /* its limit, the mean of logarithms */
    double sigma = exp(share * log_full);
    by[0] = sigma * log_full, by[1] = sigma * share;
    return sigma;
  }
  double power = exp(k * log_full); /* a small contact's share may be drawn above 1 */
  double least = k > 0 ? fmin(power, pow(LEAST, k)) : 1e-9, wanted = 1 + share * (power - 1);
  double mixed = fmax(wanted, least);
  double sigma = pow(mixed, 1 / k), slope = wanted < least * (1 - ROUNDING) ? 0.0 : sigma / mixed;
  by[0] = slope * (power - 1) / k, by[1] = slope * share * power;
  return sigma;
}

/* The same with slopes by share, pressure and log ratio. */
static double graded(const Response *r, double share, double pressure, double by[3]) {
  double slope, change = of_table(r, pressure, &slope), own[2];
  if (fabs(change) < ROUNDING) change = 0.0;
  if (change <= LEAST - 1) change = LEAST - 1, slope = 0.0;
  double sigma = blended(r->reflection, share, log(1 + change), own);
  by[0] = own[0], by[1] = own[1] * slope / (1 + change), by[2] = 0.0;
  return sigma;
}

static double saturating(const Response *r, double share, double pressure, double log_ratio,
                         double by[3]) {
  double slope = 0.0, saturation = r->count ? of_table(r, pressure, &slope) : 1.0, own[2];
  double turned = share < 0 ? -1.0 : 1.0;
  double sigma = blended(r->reflection, fabs(share), turned * log_ratio * saturation, own);
  by[0] = turned * own[0];
  by[1] = own[1] * turned * log_ratio * slope, by[2] = own[1] * turned * saturation;
  return sigma;
}

/* Conductivity ratios (n,) and their slopes (3, n); see `SheetResponse.conductivity`. */
void conduct(const Response *r, int64_t n, const double *share, const double *pressure,
             double log_ratio, double *ratio, double *slopes) {
  for (int64_t i = 0; i < n; i++) {
    double by[3];
    ratio[i] = r->saturates ? saturating(r, share[i], pressure[i], log_ratio, by)
                            : graded(r, share[i], pressure[i], by);
    for (int k = 0; k < 3; k++) slopes[k * n + i] = by[k];
  }
}

/* Relative changes that were measured, and their weights; see `Changes`. */
typedef struct {
  const double *change; /* (voltages,) */
  const double *weight; /* (voltages,) */
  int64_t drifts;
  const double *along; /* (voltages, drifts) */
  const double *share; /* (drifts,) */
} Data;

/* Take from weighted changes (voltages, count) what may be drift; `of` (drifts, count) is lost. */
static void undrift(const Sheet *s, const Data *d, int64_t count, double *changes, double *of) {
  int M = s->voltages, D = d->drifts, K = count;
  if (!D) return;
  multiply('N', 'T', K, D, M, 1.0, changes, K, d->along, D, 0.0, of, K);
  for (int64_t i = 0; i < D; i++)
    for (int64_t k = 0; k < K; k++) of[i * K + k] *= d->share[i];
  multiply('N', 'N', K, M, D, -1.0, of, K, d->along, D, 1.0, changes, K);
}

/* Changes of conductivity that a response makes of what is pressed. */
static int change_by(const Sheet *s, const Response *response, Pressing *p) {
  double *ratio = malloc(sizeof(double) * (4 * p->count + 1));
  if (!ratio) return -1;
  conduct(response, p->count, p->share, p->pressure, p->log_ratio, ratio, ratio + p->count);
  memset(p->change, 0, sizeof(double) * s->pressable);
  for (int64_t i = 0; i < p->count; i++)
    p->change[p->where[i]] = s->at_rest[p->where[i]] * (ratio[i] - 1);
  free(ratio);
  return 0;
}

/* Evaluate what is pressed on a sheet: see `FieldFit.evaluate`.
 *
 * `response` may be NULL: then the conductivities are given. `data` may be: then nothing is
 * compared. Returns UNSOLVABLE where a conductivity is not above 0.
 */
int evaluate(const Sheet *s, Areas *a, const double *green, const Response *response,
             const Data *data, Pressing *p) {
  int made = a->is_known ? 0 : know(s, green, a);
  if (!made && response) made = change_by(s, response, p);
  if (!made) made = solve(s, a, p);
  if (made || !data) return made;
  double *of = malloc(sizeof(double) * (data->drifts + 1));
  if (!of) return -1;
  for (int64_t v = 0; v < s->voltages; v++) {
    double change = (p->voltages[v] - s->bare_voltages[v]) / fabs(s->bare_voltages[v]);
    p->residual[v] = data->weight[v] * (change - data->change[v]);
  }
  undrift(s, data, 1, p->residual, of);
  free(of);
  return 0;
}

enum { STRIP = 64 }; /* triangles at once: what that takes stays in the cache */

/* Which parameters (count,) move any of a strip's triangles: how many; `active` says which ones.
 *
 * seen: (nodes,) strips in which nodes were looked at last. slot: (count,) is -1 and left so.
 */
static int find_active(const Sheet *s, const Areas *a, int64_t begin, int strip,
                       const int64_t *place, int64_t count, const double *onto, int64_t *seen,
                       int64_t *slot, int64_t *active) {
  int K = 0;
  for (int64_t i = 3 * begin; i < 3 * (begin + strip); i++) {
    int64_t p = s->corner_pressable[3 * a->triangle[i / 3] + i % 3];
    if (p < 0 || place[p] < 0 || seen[place[p]] == begin) continue;
    seen[place[p]] = begin;
    if (!onto) active[K++] = place[p];
    for (int64_t j = 0; onto && j < count; j++)
      if (onto[place[p] * count + j] != 0 && slot[j] < 0) slot[j] = K, active[K++] = j;
  }
  for (int k = 0; k < K; k++) slot[active[k]] = -1;
  return K;
}

/* How the conductivity of a strip's triangles goes by the parameters (K,) that move any of them.
 *
 * Out: weight (strip, K). slot: (count,) scratch that is -1 and left so.
 */
static void weigh(const Sheet *s, const Areas *a, int64_t begin, int strip, double exponent,
                  const double *change, const int64_t *place, int64_t count, const double *onto, int K,
                  const int64_t *active, int64_t *slot, double *weight) {
  for (int k = 0; k < K; k++) slot[active[k]] = k;
  memset(weight, 0, sizeof(double) * strip * K);
  for (int i = 0; i < strip; i++) {
    int64_t t = a->triangle[begin + i];
    double share[3], *into = weight + i * K;
    conductivity_of(s, t, exponent, change, share);
    for (int k = 0; k < 3; k++) {
      int64_t p = s->corner_pressable[3 * t + k];
      if (p < 0 || place[p] < 0) continue;
      double by = -share[k] * s->area[t]; /* minus the area that goes with the corner */
      if (!onto) into[slot[place[p]]] += by;
      for (int j = 0; onto && j < K; j++) into[j] += by * onto[place[p] * count + active[j]];
    }
  }
  for (int k = 0; k < K; k++) slot[active[k]] = -1;
}

/* Products (products, STRIP) of two pairs' fields (2, pairs, STRIP) in a strip's triangles. */
static void field_products(const Sheet *s, const Areas *a, int64_t begin, int strip,
                           const double *potentials, double *fields, double *product) {
  int P = s->pairs, Q = s->products;
  double *x = fields, *y = fields + P * STRIP;
  for (int i = 0; i < strip; i++) {
    const int64_t *corner = a->corner + 3 * (begin + i);
    const double *g = s->gradient + 6 * a->triangle[begin + i];
    const double *u = potentials + corner[0] * P, *v = potentials + corner[1] * P;
    const double *w = potentials + corner[2] * P;
    for (int p = 0; p < P; p++) {
      x[p * STRIP + i] = g[0] * u[p] + g[1] * v[p] + g[2] * w[p];
      y[p * STRIP + i] = g[3] * u[p] + g[4] * v[p] + g[5] * w[p];
    }
  }
  for (int q = 0; q < Q; q++) { /* of all places, so that it may be vectorised */
    int64_t one = s->product[2 * q] * STRIP, other = s->product[2 * q + 1] * STRIP;
    for (int i = 0; i < STRIP; i++)
      product[q * STRIP + i] = x[one + i] * x[other + i] + y[one + i] * y[other + i];
  }
}

/* Derivative of the voltages by parameters; see `ForwardModel.jacobian`.
 *
 * where: (nodes,) pressable nodes that the areas are around. potentials: (n, fields).
 * exponent, change: of the triangles' power mean, and what was solved for (pressable,). onto:
 * (nodes, count) derivatives of these nodes' conductivities by the parameters; NULL where they are
 * the parameters themselves.
 * scale: (voltages,). Out: (voltages, count).
 */
int differentiate(const Sheet *s, const Areas *a, int64_t nodes, const int64_t *where,
                  const double *potentials, double exponent, const double *change, int64_t count,
                  const double *onto, const double *scale, double *jacobian) {
  int P = s->pairs, Q = s->products, F = s->fields;
  int64_t most = onto || count < 3 * STRIP ? count : 3 * STRIP; /* that move a strip */
  size_t reals = a->nodes * P + STRIP * (2 * P + Q + most) + Q * (most + count) + 1;
  double *by_pair = malloc(sizeof(double) * reals);
  int64_t *place = malloc(sizeof(int64_t) * (s->pressable + 2 * count + nodes + 1));
  if (!by_pair || !place) {
    free(by_pair), free(place);
    return -1;
  }
  double *fields = by_pair + a->nodes * P, *product = fields + 2 * P * STRIP;
  double *weight = product + STRIP * Q;
  memset(fields, 0, sizeof(double) * 2 * P * STRIP);
  double *part = weight + STRIP * most, *summed = part + Q * most;
  int64_t *slot = place + s->pressable, *active = slot + count, *seen = active + count;
  for (int64_t i = 0; i < s->pressable; i++) place[i] = -1;
  for (int64_t i = 0; i < nodes; i++) place[where[i]] = i, seen[i] = -1;
  for (int64_t k = 0; k < count; k++) slot[k] = -1;
  memset(summed, 0, sizeof(double) * Q * count);
  for (int64_t i = 0; i < a->nodes; i++)
    for (int p = 0; p < P; p++) {
      int64_t one = s->pair[2 * p], other = s->pair[2 * p + 1]; /* the last electrode is at 0 */
      const double *u = potentials + i * F;
      by_pair[i * P + p] = (one < F ? u[one] : 0.0) - (other < F ? u[other] : 0.0);
    }
  for (int64_t begin = 0; begin < a->triangles; begin += STRIP) {
    int strip = a->triangles - begin < STRIP ? a->triangles - begin : STRIP;
    int K = find_active(s, a, begin, strip, place, count, onto, seen, slot, active);
    weigh(s, a, begin, strip, exponent, change, place, count, onto, K, active, slot, weight);
    field_products(s, a, begin, strip, by_pair, fields, product);
    multiply('N', 'N', K, Q, strip, 1.0, weight, K, product, STRIP, 0.0, part, K);
    for (int q = 0; q < Q; q++)
      for (int k = 0; k < K; k++) summed[q * count + active[k]] += part[q * K + k];
  }
  for (int64_t v = 0; v < s->voltages; v++)
    for (int64_t k = 0; k < count; k++)
      jacobian[v * count + k] = summed[s->product_of[v] * count + k] * s->sign[v] * scale[v];
  free(by_pair), free(place);
  return 0;
}

/* Derivative (voltages, parameters + 1) of a sheet's weighted residual; see `FieldFit.jacobian`.
 *
 * by_share, by_pressure: (count, parameters) of what is pressed; the last column is by the log
 * ratio. `p` has the pressed nodes and what was solved for them.
 */
int evaluate_slopes(const Sheet *s, const Areas *a, const Response *response, const Data *data,
                    const Pressing *p, int64_t parameters, const double *by_share,
                    const double *by_pressure, double *jacobian) {
  int64_t n = p->count, N = parameters + 1, M = s->voltages;
  double *ratio = malloc(sizeof(double) * (4 * n + n * N + M + data->drifts * N + 1));
  if (!ratio) return -1;
  double *slopes = ratio + n, *onto = ratio + 4 * n, *scale = onto + n * N, *of = scale + M;
  conduct(response, n, p->share, p->pressure, p->log_ratio, ratio, slopes);
  for (int64_t i = 0; i < n; i++) {
    double rest = s->at_rest[p->where[i]];
    const double *share = by_share + i * parameters, *pressure = by_pressure + i * parameters;
    for (int64_t k = 0; k < parameters; k++)
      onto[i * N + k] = rest * (slopes[i] * share[k] + slopes[n + i] * pressure[k]);
    onto[i * N + parameters] = rest * slopes[2 * n + i];
  }
  for (int64_t v = 0; v < M; v++) scale[v] = data->weight[v] / fabs(s->bare_voltages[v]);
  int made = differentiate(s, a, n, p->where, p->potentials, p->exponent, p->change, N, onto,
                           scale, jacobian);
  if (!made) undrift(s, data, N, jacobian, of);
  free(ratio);
  return made;
}

/* Contacts: the columns of their parameters, and constants, as in `scene.pressure_field`. */
enum { X, Y, SIZE, E1, E2, HARMONIC, PEAK = 9, EDGE, HOLE, COLUMNS };
static const double UNIT_M = 0.01, NOWHERE = 1e-2, GRADED_WIDTH = 0.7, RIM = 0.1;
static const double MOST_BLURRED = 0.4;
static const double PI = 3.14159265358979323846;

typedef struct {
  double half_width_m, grown_m2, unit_kpa, blur_m2;
  int64_t forms;    /* columns of the form that any contact has: 3, 5 or 9 */
  int64_t is_sharp; /* outlines as sharp as the points can show them */
} Field;

typedef struct {
  const double *each; /* (COLUMNS,) its parameters */
  double size;        /* the logarithm of its radius: less where it is the rim of a hole */
  double B[2][2], dB[3][2][2];
} Contact;

/* One contact and its hole as they are, and as they are drawn on a graded sheet: smaller, and stronger,
 * for the mesh's blur; how far outwards on a saturated one; how the logarithm of that size goes by
 * that of its own, over 1, and by gamma; the square of how far from its centre it may reach. */
typedef struct {
  Contact as_is, hole, smaller, smaller_hole;
  double wider, stronger, by_size, by_edge, reach2;
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
  double longest = each[SIZE] + hypot(each[E1], each[E2]);
  for (int h = HARMONIC; h < PEAK; h++) longest += fabs(each[h]);
  double wider = f->grown_m2 * exp(-each[SIZE]);
  double reach = exp(longest) + 2 * (f->half_width_m + wider);
  return (Sizes){.as_is = contact_of(each, each[SIZE]),
                 .hole = contact_of(each, each[SIZE] - log(2)),
                 .smaller = contact_of(each, size),
                 .smaller_hole = contact_of(each, size - log(2)),
                 .wider = wider,
                 .stronger = 1 / left,
                 .by_size = by_size,
                 .by_edge = -by_size / moment,
                 .reach2 = reach * reach};
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
  /* Below 0 by rounding, a node would pass for one that conducts worse than the bare sheet. */
  return fmax(0.5 * (1 + t + sin(PI * t) / PI), 0.0);
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

/* Whether a contact may reach a point. */
static int is_near(const Sizes *c, double x, double y) {
  double dx = x - UNIT_M * c->as_is.each[X], dy = y - UNIT_M * c->as_is.each[Y];
  return dx * dx + dy * dy < c->reach2;
}

/* Whether a contact reaches a point, and what it does there. */
static int press(const Field *f, const Sizes *c, int is_ring, double x, double y,
                 int with_slopes, Press *p) {
  if (!is_near(c, x, y)) return 0;
  p->as_is.outline = outline_at(f, &c->as_is, x, y, with_slopes);
  p->wide = p->as_is.outline.t + c->wider / f->half_width_m;
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
  if (!contact) return -1;
  for (int64_t k = 0; k < count; k++) contact[k] = sizes_of(f, each + COLUMNS * k);
  int64_t there = 0;
  for (int64_t i = 0; i < n; i++) {
    double no_wide = 1.0, no_share = 1.0, stronger = 0.0;
    double of_as_is = 0.0, as_is = 0.0, of_drawn = 0.0, drawn = 0.0;
    int hit = 0;
    for (int64_t k = 0; k < count; k++) {
      Press p;
      if (!press(f, contact + k, each[COLUMNS * k + HOLE] != 0, x[i], y[i], 0, &p)) continue;
      hit = 1;
      no_wide *= 1 - (f->is_sharp ? p.as_is.whole : p.enclosed), no_share *= 1 - p.drawn.share;
      double within = (f->is_sharp ? p.as_is.whole : p.enclosed) * p.as_is.left;
      of_as_is += within, as_is += within * p.as_is.pressure;
      of_drawn += p.drawn.share, drawn += p.drawn.share * p.drawn.pressure;
      stronger += p.drawn.share * contact[k].stronger;
    }
    if (points && !hit) continue;
    if (points) points[there] = i;
    of_as_is = fmax(of_as_is, 1e-12), of_drawn = fmax(of_drawn, 1e-12);
    enclosed[there] = 1 - no_wide, enclosed_kpa[there] = as_is / of_as_is;
    share[there] = (1 - no_share) * stronger / of_drawn, pressure[there++] = drawn / of_drawn;
  }
  free(contact);
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
  int64_t *of = malloc(sizeof(int64_t) * (2 * count + 1)), *is_free = of + count;
  if (!contact || !pressed || !of) {
    free(contact), free(pressed), free(of);
    return -1;
  }
  for (int64_t k = 0; k < count; k++) {
    contact[k] = sizes_of(f, each + COLUMNS * k), is_free[k] = 0;
    for (int q = 0; q < COLUMNS; q++) is_free[k] |= index[COLUMNS * k + q] >= 0;
  }
  size_t size = sizeof(double) * n * parameters;
  memset(by_enclosed, 0, size), memset(by_enclosed_kpa, 0, size);
  memset(by_share, 0, size), memset(by_pressure, 0, size);
  for (int64_t i = 0; i < n; i++) {
    int there = 0, is_moved = 0;
    double of_as_is = 0.0, as_is = 0.0, of_drawn = 0.0, drawn = 0.0, stronger = 0.0;
    double no_share = 1.0;
    for (int64_t k = 0; k < count; k++) is_moved |= is_free[k] && is_near(contact + k, x[i], y[i]);
    if (!is_moved) continue; /* by nothing that is free */
    for (int64_t k = 0; k < count; k++) {
      int is_ring = each[COLUMNS * k + HOLE] != 0 || index[COLUMNS * k + HOLE] >= 0;
      Press *p = pressed + there;
      if (!press(f, contact + k, is_ring, x[i], y[i], is_free[k], p)) continue;
      double within = p->enclosed * p->as_is.left;
      of_as_is += within, as_is += within * p->as_is.pressure;
      of_drawn += p->drawn.share, drawn += p->drawn.share * p->drawn.pressure;
      stronger += p->drawn.share * contact[k].stronger, no_share *= 1 - p->drawn.share;
      of[there++] = k;
    }
    of_as_is = fmax(of_as_is, 1e-12), as_is /= of_as_is;
    of_drawn = fmax(of_drawn, 1e-12), drawn /= of_drawn, stronger /= of_drawn;
    for (int j = 0; j < there; j++) {
      if (!is_free[of[j]]) continue;
      const Press *p = pressed + j;
      const Sizes *sizes = contact + of[j];
      const double *c = each + COLUMNS * of[j];
      const int64_t *places = index + COLUMNS * of[j];
      double others_wide = 1.0, others_share = 1.0; /* what is pressed twice is pressed once */
      for (int o = 0; o < there; o++)
        if (o != j) others_wide *= 1 - pressed[o].enclosed, others_share *= 1 - pressed[o].drawn.share;
      double by_wide = step_slope(p->wide), own[COLUMNS], share[COLUMNS], kpa[COLUMNS];
      double left[COLUMNS] = {0.0}; /* what a hole leaves, by all parameters */
      int is_ring = c[HOLE] != 0 || places[HOLE] >= 0;
      by_parameters(f, c, &p->as_is, is_ring, share, own);
      if (c[HOLE] != 0)
        for (int q = 0; q < f->forms; q++)
          left[q] = -c[HOLE] * step_slope(p->as_is.hole.t) * p->as_is.hole.by_t[q];
      if (is_ring) left[HOLE] = -step(f, p->as_is.hole.t);
      by_parameters(f, c, &p->drawn, is_ring, share, kpa);
      share[EDGE] = sizes->by_edge * share[SIZE], share[SIZE] += sizes->by_size * share[SIZE];
      kpa[EDGE] += sizes->by_edge * kpa[SIZE], kpa[SIZE] += sizes->by_size * kpa[SIZE];
      for (int q = 0; q < COLUMNS; q++) {
        if (places[q] < 0) continue;
        int64_t at = i * parameters + places[q];
        double by = q == SIZE ? sizes->by_size : q == EDGE ? sizes->by_edge : 0.0;
        double strength = share[q] * (sizes->stronger - stronger) -
                          2 * by * sizes->stronger * p->drawn.share;
        double enclosed = q < f->forms ? by_wide * p->as_is.outline.by_t[q] : 0.0;
        if (q == SIZE) enclosed -= by_wide * sizes->wider / f->half_width_m;
        double within = enclosed * p->as_is.left + p->enclosed * left[q];
        by_enclosed[at] = enclosed * others_wide;
        by_enclosed_kpa[at] = (within * (p->as_is.pressure - as_is) +
                               p->enclosed * p->as_is.left * own[q]) /
                              of_as_is;
        by_share[at] = share[q] * others_share * stronger + (1 - no_share) * strength / of_drawn;
        by_pressure[at] =
            (share[q] * (p->drawn.pressure - drawn) + kpa[q] * p->drawn.share) / of_drawn;
      }
    }
  }
  free(contact), free(pressed), free(of);
  return 0;
}
