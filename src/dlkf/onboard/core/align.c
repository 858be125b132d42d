/* Where a filter may start: attitude at a boundary from IMU and GNSS alone, yaw from the course, roll and pitch by
 * levelling (dlkf.data.alignment; Groves 5.6.2 with motion). The rule of the stream, all of it in this file. */
#include <math.h>
#include <string.h>

#include "constants.h"
#include "dlkf.h"
#include "geometry.h"

enum { BACK = DLKF_LEVELLED }; /* update intervals that are levelled over */
static const double EPOCH_S = DLKF_SAMPLES / DLKF_RATE_HZ;

typedef struct {
  const dlkf_fix *fix;
  double C_en[9], lat, height, v_n[3], std[3];
  double scatter[2], off; /* of positions and velocities over what they claim; m of the position from the fit */
  double lag;             /* of the velocity, s before the boundary */
} boundary;

typedef struct {
  double weight, row[6], r_n[3], tau; /* of position, velocity and acceleration: real, imaginary; s before the boundary */
} fitted;

static const double *samples(const dlkf *d, int64_t epoch) { return d->closed[epoch % DLKF_CLOSED].imu; }

static int has_position(const dlkf_fix *fix) { return fix && fix->used[0] && fix->used[1] && fix->used[2]; }

static double noise_of(const boundary *b) { return b->std[0] > b->std[1] ? b->std[0] : b->std[1]; }

static int moves(const boundary *b) { return hypot(b->v_n[0], b->v_n[1]) > MOTION_SIGMAS * noise_of(b); }

/* Mean rate of the last RATE_AVERAGE_S before a boundary, of the first where nothing is before it. */
static void rate_at(const dlkf *d, int64_t number, int64_t first, double *rate_b) {
  const double *imu = number > first ? samples(d, number - 1) + 6 * (DLKF_SAMPLES - DLKF_TAIL) : samples(d, first);
  mean3(imu + 3, DLKF_TAIL, rate_b);
}

/* Mean specific force of ``back`` update intervals before a boundary in the axes there, and
 * C_b(boundary)b(window's start). */
static void carried_force(const dlkf *d, int64_t number, int back, double *force_b, double *turned) {
  double C[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, turn[9], next[9], u[3];
  memset(force_b, 0, 3 * sizeof *force_b);
  for (int64_t epoch = number - 1; epoch >= number - back; epoch--)
    for (int k = DLKF_SAMPLES - 1; k >= 0; k--) {
      const double *x = samples(d, epoch) + 6 * k;
      double phi[3];
      for (int c = 0; c < 3; c++) phi[c] = -0.5 * x[3 + c] / DLKF_RATE_HZ;
      rotation_of(phi, turn);
      product3(C, turn, next); /* to the middle of the sample, where its force acts */
      apply3(next, x, u);
      for (int c = 0; c < 3; c++) force_b[c] += u[c];
      product3(next, turn, C);
    }
  for (int c = 0; c < 3; c++) force_b[c] /= back * DLKF_SAMPLES;
  if (turned) memcpy(turned, C, sizeof C);
}

/* Yaw that the gyroscopes turn in an update interval: rates about the direction of the force at its end. */
static double yaw_turned(const dlkf *d, int64_t epoch, int64_t first) {
  double rate_b[3], force_b[3];
  carried_force(d, epoch + 1 - BACK < first ? first + BACK : epoch + 1, BACK, force_b, NULL);
  const double size = sqrt(dot3(force_b, force_b));
  mean3(samples(d, epoch) + 3, DLKF_SAMPLES, rate_b);
  return -dot3(rate_b, force_b) / (size > 1 ? size : 1) * EPOCH_S;
}

/* Cholesky factor of A, symmetric and positive definite (6 x 6), in its lower triangle. */
static void factor6(double *A) {
  for (int i = 0; i < 6; i++)
    for (int j = 0; j <= i; j++) {
      double x = A[i * 6 + j];
      for (int k = 0; k < j; k++) x -= A[i * 6 + k] * A[j * 6 + k];
      A[i * 6 + j] = i == j ? sqrt(x) : x / A[j * 6 + j];
    }
}

static void solve_lower6(const double *L, double *x) {
  for (int i = 0; i < 6; x[i] /= L[i * 6 + i], i++)
    for (int k = 0; k < i; k++) x[i] -= L[i * 6 + k] * x[k];
}

static void solve6(const double *L, double *x) {
  solve_lower6(L, x);
  for (int i = 5; i >= 0; x[i] /= L[i * 6 + i], i--)
    for (int k = i + 1; k < 6; k++) x[i] -= L[k * 6 + i] * x[k];
}

/* Weighted least squares: solution (u, v) of the real system, variance of the velocity, and of the fixes with weight their
 * number, the sum of squared residuals over their 1-sigma, the square of the worst over its own 1-sigma and which that is;
 * 1 - h of the first. */
typedef struct {
  double x[6], variance, squares, largest, others_share;
  int fixes, worst;
} solution;

static void solve_fit(const fitted *at, int count, solution *s) {
  double A[36] = {0}, v[6];
  memset(s, 0, sizeof *s);
  for (int n = 0; n < count; n++) {
    const double *row = at[n].row, *r_n = at[n].r_n, weight = at[n].weight;
    for (int i = 0; i < 3; i++) { /* conj(x_i) x_k and conj(x_i) y */
      for (int k = 0; k < 3; k++) {
        const double re = weight * (row[i] * row[k] + row[3 + i] * row[3 + k]);
        const double im = weight * (row[i] * row[3 + k] - row[3 + i] * row[k]);
        A[6 * i + k] += re, A[6 * (i + 3) + k + 3] += re;
        A[6 * (i + 3) + k] += im, A[6 * i + k + 3] -= im;
      }
      s->x[i] += weight * (row[i] * r_n[0] + row[3 + i] * r_n[1]);
      s->x[3 + i] += weight * (row[i] * r_n[1] - row[3 + i] * r_n[0]);
    }
  }
  for (int k = 0; k < 6; k++) A[7 * k] += k % 3 < 2 ? 1e-9 : 1 / (ACCELERATION_STD * ACCELERATION_STD);
  factor6(A);
  solve6(A, s->x);
  for (int k = 0; k < 6; k++) v[k] = k == 1;
  solve6(A, v);
  s->variance = v[1];
  for (int n = 0; n < count; n++) {
    const double *row = at[n].row, *x = s->x;
    double east = at[n].r_n[1], north = at[n].r_n[0];
    for (int k = 0; k < 3; k++) {
      north -= row[k] * x[k] - row[3 + k] * x[3 + k], east -= row[k] * x[3 + k] + row[3 + k] * x[k];
      v[k] = row[k], v[3 + k] = -row[3 + k];
    }
    solve_lower6(A, v);
    double others = 1 - at[n].weight * (dot3(v, v) + dot3(v + 3, v + 3)); /* 1 - h */
    if (others < LEAST_SHARE) others = LEAST_SHARE;
    const double square = at[n].weight * (north * north + east * east);
    if (square / others > s->largest) s->largest = square / others, s->worst = n;
    if (!n) s->others_share = others;
    s->squares += square;
    s->fixes += at[n].weight > 0;
  }
}

/* 1-sigma of a position or velocity that scatters so many times more than claimed. */
double dlkf_scattered(double std, const double *scatter, int velocity) {
  const double floor = velocity ? JOLT_STD : FIT_STD, more = scatter[velocity] * scatter[velocity] - 1;
  return sqrt(std * std + more * (std * std + floor * floor));
}

/* Velocity fitted to the positions of FIT_S before a boundary, with the turns of the gyroscopes and without outliers; 0
 * where they are fewer than three, or the boundary's is one. Complex numbers are north + i east; u + i v solves as a real
 * system of (u, v) (dlkf.data.velocity_fit). */
static int fit_velocity(const dlkf *d, int64_t number, int64_t first, boundary *b) {
  double yaw = 0, before[2] = {1, 0}, way[2] = {0, 0}, slowed[2] = {0, 0}, u[3], span = 0;
  double D[3] = {1e-9, 0, 0}, down[2] = {0};
  fitted at[DLKF_FITTED + 1];
  int count = 0;
  for (int j = 0; j <= DLKF_FITTED && number - j >= first; j++) {
    const double tau = j * EPOCH_S;
    if (j) {
      yaw -= yaw_turned(d, number - j, first);
      const double heading[2] = {cos(yaw), sin(yaw)};
      for (int c = 0; c < 2; c++) {
        const double middle = 0.5 * (heading[c] + before[c]) * EPOCH_S;
        way[c] += middle;
        slowed[c] += middle * (tau - 0.5 * EPOCH_S);
        before[c] = heading[c];
      }
    }
    const dlkf_fix *fix = dlkf_fix_at(d, number - j);
    if (!has_position(fix)) continue;
    double late[2] = {0, 0}; /* the way since a fix to its boundary, over which the car turns evenly */
    if (fix->lag > 0) {
      const double turn = number - j > first ? yaw_turned(d, number - j - 1, first) * fix->lag / EPOCH_S : 0;
      late[0] = 0.5 * (before[0] + cos(yaw - turn)) * fix->lag, late[1] = 0.5 * (before[1] + sin(yaw - turn)) * fix->lag;
    }
    double std = fix->std[0] > fix->std[1] ? fix->std[0] : fix->std[1];
    std = hypot(fix->std[2] > std ? fix->std[2] : std, FIT_STD);
    fitted *one = &at[count];
    *one = (fitted){1 / (std * std), {1, 0, 0, 0, 0, 0}, {0}, tau + fix->lag};
    for (int c = 0; c < 2; c++) {
      one->row[3 * c + 1] = -(way[c] + late[c]);
      one->row[3 * c + 2] = slowed[c] + late[c] * (tau + 0.5 * fix->lag);
    }
    for (int k = 0; k < 3; k++) u[k] = fix->r_e[k] - b->fix->r_e[k];
    apply3_transposed(b->C_en, u, at[count++].r_n);
  }
  solution s;
  for (int round = 0;; round++) { /* data snooping */
    solve_fit(at, count, &s);
    const int redundancy = 2 * s.fixes - 5;
    double others = (s.squares - s.largest) / (redundancy > 3 ? redundancy - 2 : 1);
    if (others < 1) others = 1;
    if (round == MOST_OUTLIERS || redundancy < OVERDETERMINED) break;
    if (!(s.largest > OUTLIER_SIGMAS * OUTLIER_SIGMAS * others)) break;
    at[s.worst].weight = 0;
  }
  if (s.fixes < LEAST_FITTED || !(at[0].weight > 0)) return 0;
  const double squares = s.squares / (s.fixes > 4 ? 2 * s.fixes - 7 : 1);
  b->scatter[0] = squares > 1 ? sqrt(squares) : 1;
  const double *row = at[0].row;
  double north = 0, east = 0;
  for (int k = 0; k < 3; k++) north += row[k] * s.x[k] - row[3 + k] * s.x[3 + k], east += row[k] * s.x[3 + k] + row[3 + k] * s.x[k];
  b->off = hypot(north, east) / s.others_share;
  b->lag = 0;
  for (int n = 0; n < count; n++) {
    const double weight = at[n].weight, tau = at[n].tau;
    if (weight > 0) span = tau;
    D[0] += weight, D[1] -= weight * tau, D[2] += weight * tau * tau;
    down[0] += weight * at[n].r_n[2], down[1] -= weight * tau * at[n].r_n[2];
  }
  b->v_n[0] = s.x[1], b->v_n[1] = s.x[4];
  const double speed = hypot(s.x[1], s.x[4]), slope = UNKNOWN_VELOCITY_STD + UNKNOWN_SLOPE_STD * speed;
  b->std[0] = b->std[1] = hypot(b->scatter[0] * sqrt(s.variance), 0.5 * GYRO_BIAS_STD * span * speed);
  D[2] += 1 / (slope * slope);
  const double determinant = D[0] * D[2] - D[1] * D[1];
  b->v_n[2] = (D[0] * down[1] - D[1] * down[0]) / determinant;
  b->std[2] = sqrt(D[0] / determinant);
  return moves(b);
}

/* The boundary at which a fix with a position is; 0 where there is none. */
static int find_boundary(const dlkf *d, int64_t number, boundary *b) {
  double lon;
  b->fix = dlkf_fix_at(d, number);
  b->scatter[0] = b->scatter[1] = 1, b->off = 0;
  if (!has_position(b->fix)) return 0;
  b->lag = b->fix->lag;
  geodetic_from_ecef(b->fix->r_e, &b->lat, &lon, &b->height);
  ned_axes(b->lat, lon, b->C_en);
  return 1;
}

/* The velocity of the receiver at a boundary with its 1-sigma. */
static int read_velocity(const dlkf *d, int64_t number, boundary *b) {
  if (!find_boundary(d, number, b) || !b->fix->used[3] || !b->fix->used[4]) return 0;
  apply3_transposed(b->C_en, b->fix->v_e, b->v_n);
  if (!b->fix->used[5]) b->v_n[2] = 0;
  const double guess = UNKNOWN_VELOCITY_STD + UNKNOWN_SLOPE_STD * hypot(b->v_n[0], b->v_n[1]);
  for (int k = 0; k < 3; k++) b->std[k] = b->fix->used[3 + k] ? b->fix->std[3 + k] : guess;
  return 1;
}

typedef int given(const dlkf *, int64_t, int64_t); /* at a boundary, of fixes from the first on */

static int has_velocity(const dlkf *d, int64_t number, int64_t first) {
  const dlkf_fix *fix = dlkf_fix_at(d, number);
  (void)first;
  return has_position(fix) && fix->used[3] && fix->used[4];
}

static int has_place(const dlkf *d, int64_t number, int64_t first) {
  (void)first;
  return has_position(dlkf_fix_at(d, number));
}

/* How many update intervals before a boundary, at least ``least``, the last is that is given; 0 where REACH_S has none. */
static int last_before(const dlkf *d, int64_t number, int64_t first, int least, given *is_given) {
  for (int j = least; (j <= least || j <= DLKF_REACH) && number - j >= first; j++)
    if (is_given(d, number - j, first)) return j;
  return 0;
}

/* Whether a velocity is one that a car can have after the one before, if there is one. */
static int agrees(const dlkf *d, int64_t number, int64_t first, const boundary *b) {
  boundary before;
  double yaw = 0;
  const int back = last_before(d, number, first, DLKF_CONFIRMED, has_velocity);
  if (!back || !read_velocity(d, number - back, &before)) return 1;
  for (int j = 1; j <= back; j++) yaw += yaw_turned(d, number - j, first);
  const double north = b->v_n[0] - (cos(yaw) * before.v_n[0] - sin(yaw) * before.v_n[1]);
  const double east = b->v_n[1] - (sin(yaw) * before.v_n[0] + cos(yaw) * before.v_n[1]);
  const double may = CHANGE_SIGMAS * hypot(noise_of(b), noise_of(&before)) + MOST_ACCELERATION * EPOCH_S * back;
  return hypot(north, east) <= may;
}

/* The square among some of a window, in ascending order. */
static void sort_in(double *squares, int *count, double square) {
  int at = (*count)++;
  for (; at && squares[at - 1] > square; at--) squares[at] = squares[at - 1];
  squares[at] = square;
}

/* At least 1; 1 where they are few. */
static double root_of_median(const double *squares, int count) {
  const double median = count >= LEAST_DIFFERENCES ? squares[(count - 1) / 2] : 1;
  return median > 1 ? sqrt(median) : 1;
}

/* How many times more than claimed the velocities of FIT_S before a boundary scatter, by their second differences. */
static double scatter_of_velocities(const dlkf *d, int64_t number, int64_t first) {
  enum { SPAN = DLKF_FITTED + 1 + 2 * DLKF_CONFIRMED };
  double level[SPAN][2], noise[SPAN], squares[DLKF_FITTED + 1], yaw = 0;
  int given[SPAN], found = 0;
  for (int j = 0; j < SPAN; j++) { /* turned back with the gyroscopes, but for one turn of all */
    boundary b;
    given[j] = number - j >= first && read_velocity(d, number - j, &b);
    if (j && number - j >= first) yaw += yaw_turned(d, number - j, first);
    if (!given[j]) continue;
    level[j][0] = cos(yaw) * b.v_n[0] - sin(yaw) * b.v_n[1];
    level[j][1] = sin(yaw) * b.v_n[0] + cos(yaw) * b.v_n[1];
    noise[j] = noise_of(&b);
  }
  for (int j = 0; j <= DLKF_FITTED; j++) {
    const int one = j + DLKF_CONFIRMED, two = one + DLKF_CONFIRMED;
    if (!given[j] || !given[one] || !given[two]) continue;
    const double north = level[j][0] - 2 * level[one][0] + level[two][0];
    const double east = level[j][1] - 2 * level[one][1] + level[two][1];
    const double variance = noise[j] * noise[j] + JOLT_STD * JOLT_STD;
    sort_in(squares, &found, (north * north + east * east) / (SECOND_DIFFERENCE * variance));
  }
  return root_of_median(squares, found);
}

/* The same of positions, by their differences from the way by velocities, of which the scatter is known. */
static double scatter_of_positions(const dlkf *d, int64_t number, int64_t first, const double *scatter) {
  const double half = 0.5 * EPOCH_S;
  double squares[DLKF_FITTED + 1], u[3], step[3];
  int found = 0;
  for (int j = 0; j <= DLKF_FITTED; j++) {
    boundary now, then;
    double way[2] = {0}, variance = 0;
    int given = number - j - DLKF_CONFIRMED >= first && read_velocity(d, number - j, &now);
    then = now;
    for (int k = 1; given && k <= DLKF_CONFIRMED; k++) {
      const boundary after = then;
      given = read_velocity(d, number - j - k, &then);
      for (int c = 0; given && c < 2; c++) way[c] += half * (after.v_n[c] + then.v_n[c]);
    }
    if (!given) continue;
    for (int k = 0; k < 3; k++) u[k] = now.fix->r_e[k] - then.fix->r_e[k];
    apply3_transposed(now.C_en, u, step);
    const boundary *both[2] = {&now, &then};
    for (int k = 0; k < 2; k++) {
      const double *claimed = both[k]->fix->std, std = claimed[0] > claimed[1] ? claimed[0] : claimed[1];
      variance += std * std + FIT_STD * FIT_STD;
      variance += square_of(DLKF_CONFIRMED * half * dlkf_scattered(noise_of(both[k]), scatter, 1));
      for (int c = 0; c < 2; c++) way[c] += (k ? 1 : -1) * both[k]->fix->lag * both[k]->v_n[c];
    }
    sort_in(squares, &found, (square_of(step[0] - way[0]) + square_of(step[1] - way[1])) / (DIFFERENCE * variance));
  }
  return root_of_median(squares, found);
}

/* Whether of the fixes of FIT_S before a boundary no more than half have a velocity, and enough have a position. */
static int few_velocities(const dlkf *d, int64_t number, int64_t first) {
  int positions = 0, velocities = 0;
  for (int j = 0; j <= DLKF_FITTED && number - j >= first; j++) {
    const dlkf_fix *fix = dlkf_fix_at(d, number - j);
    if (!has_position(fix)) continue;
    positions++;
    velocities += fix->used[3] && fix->used[4] && fix->std[3] < UNKNOWN_STD && fix->std[4] < UNKNOWN_STD;
  }
  return positions >= LEAST_FITTED && 2 * velocities <= positions;
}

/* The velocity of the receiver at a boundary, where it is no outlier, with the 1-sigma that it scatters by. */
static int read_received(const dlkf *d, int64_t number, int64_t first, boundary *b) {
  if (!read_velocity(d, number, b) || !agrees(d, number, first, b)) return 0;
  b->scatter[1] = scatter_of_velocities(d, number, first);
  b->scatter[0] = scatter_of_positions(d, number, first, b->scatter);
  for (int k = 0; k < 2; k++) b->std[k] = dlkf_scattered(b->std[k], b->scatter, 1);
  return 1;
}

/* Velocity of the antenna at a boundary with its 1-sigma; where few fixes have any, from positions, if by those before
 * it the car moved too. 0 where it is none, or an outlier. */
static int read_boundary(const dlkf *d, int64_t number, int64_t first, boundary *b) {
  boundary before;
  if (!few_velocities(d, number, first)) return read_received(d, number, first, b);
  const int back = last_before(d, number, first, DLKF_CONFIRMED, has_place);
  return find_boundary(d, number, b) && fit_velocity(d, number, first, b) && back &&
         find_boundary(d, number - back, &before) && fit_velocity(d, number - back, first, &before);
}

/* Whether the car moves, and did by the velocity before. */
static int is_moving(const dlkf *d, int64_t number, int64_t first, const boundary *now) {
  boundary before;
  if (few_velocities(d, number, first)) return 1;
  const int back = last_before(d, number, first, DLKF_CONFIRMED, has_velocity);
  return moves(now) && back && read_received(d, number - back, first, &before) && moves(&before);
}

static int is_levelled_from(const dlkf *d, int64_t number, int64_t first) {
  return few_velocities(d, number, first) ? has_place(d, number, first) : has_velocity(d, number, first);
}

/* A start at the beginning of a closed update interval: latitude, longitude [rad], height [m] of the IMU, velocity (3)
 * and attitude (9) in the tangent frame there, 1-sigma of position, velocity, attitude (9), gyroscope bias (3) and its
 * 1-sigma (3), unknown here, and how many times more than claimed positions and velocities scatter (2), as
 * dlkf.filters.fix_noise has it; the mean specific force of the window before; and that scatter as dlkf_scattered takes
 * it (2). 0 where there is none. */
int dlkf_align(const dlkf *d, int64_t epoch, double *start, double *u_b, double *scatter) {
  const int64_t first = epoch - d->oldest > DLKF_LOOKBACK ? epoch - DLKF_LOOKBACK : d->oldest;
  const double *arm = d->lever_arm_b;
  boundary now, then;
  if (epoch - BACK < first) return 0;
  if (!few_velocities(d, epoch, first) && !(read_velocity(d, epoch, &now) && hypot(now.v_n[0], now.v_n[1]) > MIN_SPEED))
    return 0; /* quick */
  if (!read_boundary(d, epoch, first, &now) || !is_moving(d, epoch, first, &now)) return 0;
  const int back = last_before(d, epoch, first, BACK, is_levelled_from);
  if (!back || !read_boundary(d, epoch - back, first, &then)) return 0;
  const double lag = now.lag, lag_then = then.lag, span = back * EPOCH_S - lag + lag_then;
  const double speed = hypot(now.v_n[0], now.v_n[1]), slow = speed > 0.1 ? speed : 0.1;
  const double noise = noise_of(&now);
  if (!(span > 0.5 * EPOCH_S) || !(speed > MIN_SPEED) || !(speed > MOTION_SIGMAS * noise)) return 0;

  double turned[9], force_b[3], rate_b[3], rate_then[3], swing_b[3], swing_then[3], u[3], w[3];
  carried_force(d, epoch, BACK, u_b, NULL);
  carried_force(d, epoch, back, force_b, turned);
  rate_at(d, epoch, first, rate_b);
  rate_at(d, epoch - back, first, rate_then);
  /* velocity of the IMU in n at both ends: the antenna's less the lever-arm velocity */
  cross3(rate_b, arm, swing_b);
  cross3(rate_then, arm, swing_then);
  double slip = swing_b[1] / slow;
  slip = asin(slip > 0.9 ? 0.9 : slip < -0.9 ? -0.9 : slip);
  const double yaw = atan2(now.v_n[1], now.v_n[0]) - slip + lag * rate_b[2];
  double C_level[9], v_imu[3], v_then[3], acceleration[3], u_n[3], u_h[3], C_nb[9];
  rotation_from_rpy(0, 0, yaw, C_level);
  apply3(C_level, swing_b, u);
  for (int k = 0; k < 3; k++) v_imu[k] = now.v_n[k] - u[k];
  apply3(turned, swing_then, w);
  apply3(C_level, w, u);
  for (int k = 0; k < 3; k++) v_then[k] = then.v_n[k] - u[k];
  for (int k = 0; k < 3; k++) acceleration[k] = (v_imu[k] - v_then[k]) / span;
  const double earth_n[3] = {EARTH_RATE * cos(now.lat), 0, -EARTH_RATE * sin(now.lat)};
  for (int k = 0; k < 3; k++) w[k] = (v_imu[k] + v_then[k]) / 2;
  cross3(earth_n, w, u);
  for (int k = 0; k < 3; k++) u_n[k] = acceleration[k] + 2 * u[k];
  u_n[2] -= normal_gravity(sin(now.lat), now.height);
  apply3_transposed(C_level, u_n, u_h);
  double roll, pitch;
  level3(force_b, u_h, &roll, &pitch);
  rotation_from_rpy(roll, pitch, yaw, C_nb);

  double r_e[3], v_e[3], C_eb[9], C_new[9];
  for (int k = 0; k < 3; k++) u[k] = now.fix->lag * now.v_n[k];
  apply3(now.C_en, u, w);
  product3(now.C_en, C_nb, C_eb);
  apply3(C_eb, arm, u);
  for (int k = 0; k < 3; k++) r_e[k] = now.fix->r_e[k] + w[k] - u[k];
  for (int k = 0; k < 3; k++) u[k] = v_imu[k] + lag * acceleration[k];
  apply3(now.C_en, u, v_e);
  geodetic_from_ecef(r_e, &start[0], &start[1], &start[2]);
  ned_axes(start[0], start[1], C_new);
  apply3_transposed(C_new, v_e, start + 3);
  product3_transposed(C_new, C_eb, start + 6);

  const double shift = lag > lag_then ? lag : lag_then; /* of the velocities' window against the IMU's */
  const double jolt = 1.41 * noise / span, jerk = JERK_STD * shift, turning = AXLE_STD * rate_b[2];
  const double pull = jolt * jolt + jerk * jerk + ACCEL_BIAS_STD * ACCEL_BIAS_STD; /* (m/s2)2 */
  double *std = start + 15;
  for (int k = 0; k < 3; k++) std[k] = hypot(dlkf_scattered(now.fix->std[k], now.scatter, 0), now.off);
  for (int k = 0; k < 3; k++) std[3 + k] = now.std[k];
  std[6] = std[7] = sqrt(pull / (STANDARD_GRAVITY * STANDARD_GRAVITY) + SPREAD_STD * SPREAD_STD);
  std[8] = sqrt(SIDESLIP_STD * SIDESLIP_STD + (noise * noise + turning * turning) / (slow * slow));
  memcpy(scatter, now.scatter, sizeof now.scatter);
  const double *of_velocity = now.fix->std + 3, claimed = of_velocity[0] > of_velocity[1] ? of_velocity[0] : of_velocity[1];
  start[30] = now.scatter[0];
  start[31] = now.scatter[1] > 1 ? dlkf_scattered(claimed, now.scatter, 1) / claimed : 1;
  double sum = 0;
  for (int k = 0; k < 24; k++) sum += start[k];
  for (int k = 0; k < 3; k++) start[24 + k] = 0, start[27 + k] = INFINITY;
  return isfinite(sum);
}
