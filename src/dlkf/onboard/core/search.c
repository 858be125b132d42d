/* Which way the car faces: headings side by side, each a filter of its own, until one has won; and what a standstill
 * before has shown (dlkf.running.start.bank, dlkf.running.start.standstill). The equations of a heading are heading.c. */
#include <math.h>
#include <string.h>

#include "constants.h"
#include "dlkf.h"
#include "geometry.h"

#if DLKF_SEARCH_S > 0
enum { REST = DLKF_REST < DLKF_LOOKBACK ? DLKF_REST : DLKF_LOOKBACK }; /* update intervals before that are looked at */
static const double EPOCH_S = DLKF_SAMPLES / DLKF_RATE_HZ;

typedef struct {
  double shown[3], error[3], std; /* rate of a car that does not turn, how much of it is the gyroscopes', its 1-sigma */
  double level_b[3], level_std;   /* force of the last standstill in the axes at the boundary; level_std < 0: none */
} standstill;

static const double *samples(const dlkf *d, int64_t epoch) { return d->closed[epoch % DLKF_CLOSED].imu; }

static double length3(const double *u) { return sqrt(dot3(u, u)); }

static double largest3(const double *u) {
  const double x = u[0] > u[1] ? u[0] : u[1];
  return u[2] > x ? u[2] : x;
}

static int known(const int32_t *used) { return used[0] && used[1] && used[2]; }

/* Whether samples scatter and turn no more than those of a car at rest. */
static int samples_rest(const double *imu) {
  for (int s = 0; s < 2; s++) {
    double mean[3], squares = 0;
    mean3(imu + 3 * s, DLKF_SAMPLES, mean);
    for (int k = 0; k < DLKF_SAMPLES; k++)
      for (int c = 0; c < 3; c++) squares += square_of(imu[6 * k + 3 * s + c] - mean[c]);
    if (!(sqrt(squares / DLKF_SAMPLES) <= (s ? REST_SPREAD_GYRO : REST_SPREAD_ACCEL))) return 0;
    if (s && !(length3(mean) <= REST_RATE)) return 0;
  }
  return 1;
}

static int slow(const dlkf_fix *fix) { return length3(fix->v_e) <= REST_SPEED + 2 * largest3(fix->std + 3); }

/* Whether two fixes that many update intervals apart are good, and at one place. */
static int near(const dlkf_fix *one, const dlkf_fix *two, int apart) {
  if (!one || !two || !known(one->used) || !known(two->used)) return 0;
  const double a = largest3(one->std), b = largest3(two->std);
  double way[3];
  for (int c = 0; c < 3; c++) way[c] = two->r_e[c] - one->r_e[c];
  return a <= REST_POSITION_STD && b <= REST_POSITION_STD && length3(way) <= REST_SPEED * apart * EPOCH_S + 2 * (a + b);
}

/* Whether the fixes round an update interval of those from `first` to before `end` do not move. */
static int fixes_rest(const dlkf *d, int64_t epoch, int64_t first, int64_t end) {
  const dlkf_fix *one = dlkf_fix_at(d, epoch), *two = dlkf_fix_at(d, epoch + 1);
  if (!one || !two) return 0;
  if (one->used[3] && one->used[4] && two->used[3] && two->used[4]) return slow(one) && slow(two);
  if (!known(one->used) || !known(two->used)) return 0;
  const int apart = DLKF_STILL < end - first ? DLKF_STILL : (int)(end - first);
  for (int64_t k = epoch - apart + 1; k <= epoch; k++)
    if (k >= first && k + apart <= end && near(dlkf_fix_at(d, k), dlkf_fix_at(d, k + apart), apart)) return 1;
  return 0;
}

/* What the update intervals before a boundary have shown of gyroscopes and level; C_eb is the attitude there. */
static void read_standstill(const dlkf *d, int64_t number, const double *C_eb, standstill *s) {
  const int64_t oldest = number - d->oldest > DLKF_LOOKBACK ? number - DLKF_LOOKBACK : d->oldest;
  const int64_t first = number - oldest > REST ? number - REST : oldest;
  int64_t begin = number, last_begin = -1, last_end = -1; /* of a run at rest, and of the last long enough */
  double sum[3] = {0}, squares[3] = {0}, noise = 0, mean[3];
  int64_t count = 0;
  for (int pass = 0; pass < 2; pass++) { /* the mean first, then the spread about it */
    int64_t length = 0;
    for (int64_t epoch = first; epoch <= number; epoch++) {
      if (epoch < number && samples_rest(samples(d, epoch)) && fixes_rest(d, epoch, first, number)) {
        if (!length++) begin = epoch;
        continue;
      }
      for (int64_t k = begin; length >= DLKF_STILL && k < epoch; k++)
        for (int j = 0; j < DLKF_SAMPLES; j++)
          for (int c = 0; c < 3; c++) {
            const double x = samples(d, k)[6 * j + 3 + c];
            if (pass) squares[c] += square_of(x - sum[c] / (double)count);
            else sum[c] += x;
          }
      if (length >= DLKF_STILL) {
        last_begin = begin, last_end = epoch;
        if (!pass) count += length * DLKF_SAMPLES;
      }
      length = 0;
    }
  }
  s->level_std = -1;
  for (int c = 0; c < 3; c++) s->shown[c] = EARTH_RATE * C_eb[6 + c], s->error[c] = 0;
  s->std = RATE_STD;
  if (!count) return;
  for (int c = 0; c < 3; c++) {
    const double spread = sqrt(squares[c] / (double)(count - 1));
    if (spread > noise) noise = spread;
    mean[c] = sum[c] / (double)count;
    s->error[c] = mean[c] - s->shown[c];
    s->shown[c] = mean[c];
  }
  s->std = hypot(RATE_DRIFT_STD, noise / sqrt((double)count));

  double force_b[3] = {0}, C[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, turn[9], next[9], phi[3], turned[3] = {0};
  for (int64_t k = last_begin; k < last_end; k++) {
    mean3(samples(d, k), DLKF_SAMPLES, mean);
    for (int c = 0; c < 3; c++) force_b[c] += mean[c] / (double)(last_end - last_begin);
  }
  for (int64_t k = number - 1; k >= last_end; k--) { /* C_b(number)b(last_end) */
    for (int j = DLKF_SAMPLES - 1; j >= 0; j--) {
      for (int c = 0; c < 3; c++) phi[c] = (s->shown[c] - samples(d, k)[6 * j + 3 + c]) / DLKF_RATE_HZ;
      rotation_of(phi, turn);
      product3(C, turn, next);
      memcpy(C, next, sizeof C);
    }
    mean3(samples(d, k) + 3, DLKF_SAMPLES, mean);
    for (int c = 0; c < 3; c++) turned[c] += (mean[c] - s->shown[c]) * EPOCH_S;
  }
  apply3(C, force_b, s->level_b);
  const double drift = s->std * EPOCH_S * (double)(number - last_end);
  s->level_std = hypot(SPREAD_STD, hypot(drift, RATE_SCALE_STD * length3(turned)));
}

/* Attitude with the yaw of C under which force_b is force_n (dlkf.data.alignment.level_attitude). */
static void level_attitude(const double *C, const double *force_b, const double *force_n, double *out) {
  const double yaw = atan2(C[3], C[0]);
  double C_level[9], force_h[3], roll, pitch;
  rotation_from_rpy(0, 0, yaw, C_level);
  apply3_transposed(C_level, force_n, force_h);
  level3(force_b, force_h, &roll, &pitch);
  rotation_from_rpy(roll, pitch, yaw, out);
}

static const struct {
  int place, count;
} OWN[] = DLKF_HEADING_OWN; /* what of a memory belongs to a heading, one behind the other in own[] */

static void put_own(const double *own, double *memory) {
  for (unsigned k = 0; k < sizeof OWN / sizeof *OWN; own += OWN[k++].count)
    memcpy(memory + OWN[k].place, own, (size_t)OWN[k].count * sizeof *own);
}

static void get_own(const double *memory, double *own) {
  for (unsigned k = 0; k < sizeof OWN / sizeof *OWN; own += OWN[k++].count)
    memcpy(own, memory + OWN[k].place, (size_t)OWN[k].count * sizeof *own);
}

/* 1-sigma of the down direction of an attitude C_nb and a force: chi squared of their angle, at most NIS_CAP. */
static double apart_chi2(const double *C_nb, const double *force_b, double variance) {
  const double size = length3(force_b), up_n[3] = {0, 0, -1};
  double up_b[3], u[3], angle[3];
  apply3_transposed(C_nb, up_n, up_b);
  for (int c = 0; c < 3; c++) u[c] = force_b[c] / size;
  cross3(up_b, u, angle);
  const double chi2 = dot3(angle, angle) / variance;
  return chi2 < NIS_CAP ? chi2 : NIS_CAP;
}

/* All headings at the beginning of a closed update interval: the course, its reverse, and where the course is coarse a
 * ring. 0 where the car does not move under GNSS. */
int dlkf_search_begin(dlkf *d, int64_t number) {
  dlkf_search *s = &d->now.search;
  double force_b[3], C_en[9], C_eb[9], rate_b[3], force_n[3];
  standstill rest;
  if (!dlkf_align(d, number, s->start, force_b, s->scatter)) return 0;
  const double *C_nb = s->start + 6, *std = s->start + 15, *arm = d->lever_arm_b;
  ned_axes(s->start[0], s->start[1], C_en);
  product3(C_en, C_nb, C_eb);
  read_standstill(d, number, C_eb, &rest);
  mean3(samples(d, number) + 3, DLKF_TAIL, rate_b);
  apply3(C_nb, force_b, force_n);
  const double speed = hypot(s->start[3], s->start[4]), tilt = std[6];
  const double reverse = log(REVERSE_PRIOR) - 0.5 * square_of(speed / REVERSE_SPEED);
  double *memory = d->work + DLKF_WORK - DLKF_HEADING;
  for (int h = 0; h < DLKF_HEADINGS; h++) {
    const double turn = h < 2 ? h * PI : 2 * PI / RING * (h - 2 + 0.5);
    double Rz[9], C[9], level[9], one[DLKF_START];
    s->score[h] = h == 0 ? log(1 - REVERSE_PRIOR) : h == 1 ? reverse : -(double)INFINITY;
    if (h > 1 && std[8] > COARSE) s->score[h] = log(RING_PRIOR / RING) + (cos(turn) < 0 ? reverse : 0);
    rotation_from_rpy(0, 0, turn, Rz);
    product3(Rz, C_nb, C);
    level_attitude(C, force_b, force_n, level);
    memcpy(one, s->start, sizeof one);
    one[15 + 8] = h < 2 ? std[8] : PI / RING;
    if (rest.level_std >= 0) {
      const double up[3] = {0, 0, -length3(rest.level_b)};
      s->score[h] -= 0.5 * apart_chi2(level, rest.level_b, square_of(rest.level_std) + square_of(tilt));
      memcpy(C, level, sizeof C);
      level_attitude(C, rest.level_b, up, level);
      one[15 + 6] = one[15 + 7] = hypot(rest.level_std, ACCEL_BIAS_STD / STANDARD_GRAVITY);
    }
    /* the lever arm as the attitude has it */
    double less[9], swing_b[3], dp[3], dv[3];
    for (int k = 0; k < 9; k++) less[k] = C_nb[k] - level[k];
    apply3(less, arm, dp);
    cross3(rate_b, arm, swing_b);
    apply3(less, swing_b, dv);
    for (int c = 0; c < 3; c++) one[3 + c] += dv[c];
    memcpy(one + 6, level, sizeof level);
    for (int c = 0; c < 3 && rest.level_std >= 0; c++)
      one[24 + c] = rest.error[c], one[27 + c] = rest.std > LEAST_BIAS_STD ? rest.std : LEAST_BIAS_STD;
    dlkf_heading_start(one, arm, memory, d->work);
    for (int c = 0; c < 3; c++) memory[DLKF_HEADING_AT_P + c] += dp[c];
    get_own(memory, s->own[h]);
  }
  s->epochs = 0;
  s->weighed = 1;
  return 1;
}

/* An update interval on; 0 where the headings cannot be weighed any more. */
int dlkf_search_advance(dlkf *d, const double *imu, int64_t boundary) {
  dlkf_search *s = &d->now.search;
  double fix[19], score, best = -INFINITY, *out = d->work + DLKF_WORK - DLKF_HEADING, *memory = out - DLKF_HEADING;
  dlkf_heading_start(s->start, d->lever_arm_b, memory, d->work); /* what all have in common */
  dlkf_read_fix(d, boundary, memory + DLKF_HEADING_AT_ORIGIN, memory + DLKF_HEADING_AT_AXES, fix);
  for (int k = 6; k < 12; k++) fix[k] = dlkf_scattered(fix[k], s->scatter, k > 8);
  s->weighed = 0;
  for (int k = 12; k < 18; k++) s->weighed |= fix[k] > 0;
  for (int h = 0; h < DLKF_HEADINGS; h++) {
    if (isinf(s->score[h])) continue; /* none from the beginning */
    put_own(s->own[h], memory);
    dlkf_heading_turn(memory, imu, fix, out, &score, d->work);
    get_own(out, s->own[h]);
    s->score[h] += score;
    if (!isfinite(s->score[h])) return 0;
    if (s->score[h] > best) best = s->score[h];
  }
  s->epochs++;
  return isfinite(best);
}

/* Yaw [rad] of the rotation C, the third of its rotation vector through the quaternion. */
static double yaw_of(const double *C) {
  const double pivot[4] = {1 + C[0] + C[4] + C[8], 1 + C[0] - C[4] - C[8], 1 - C[0] + C[4] - C[8], 1 - C[0] - C[4] + C[8]};
  const double a = C[7] - C[5], b = C[2] - C[6], c = C[3] - C[1], e = C[3] + C[1], f = C[2] + C[6], g = C[7] + C[5];
  const double rows[4][4] = {{pivot[0], a, b, c}, {a, pivot[1], e, f}, {b, e, pivot[2], g}, {c, f, g, pivot[3]}};
  int best = 0;
  for (int k = 1; k < 4; k++)
    if (pivot[k] > pivot[best]) best = k;
  const double *q = rows[best], vector = length3(q + 1);
  if (!(vector > 0)) return 0;
  return 2 * atan2(vector, fabs(q[0])) * (q[0] < 0 ? -q[3] : q[3]) / vector;
}

/* The likeliest heading as a start, where it is good enough for one: 1; and the probability of any other. */
int dlkf_search_start(dlkf *d, double *start) {
  dlkf_search *s = &d->now.search;
  double sum = 0, other = 0, r_e[3], v_e[3], C_eb[9], C_new[9];
  int best = 0;
  for (int h = 1; h < DLKF_HEADINGS; h++)
    if (s->score[h] > s->score[best]) best = h;
  const double *chosen = s->own[best] + DLKF_HEADING_OWN_C;
  for (int h = 0; h < DLKF_HEADINGS; h++) {
    if (isinf(s->score[h])) continue;
    const double *C = s->own[h] + DLKF_HEADING_OWN_C, p = exp(s->score[h] - s->score[best]);
    double apart[9];
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) apart[3 * i + j] = dot3(C + 3 * i, chosen + 3 * j); /* C chosen' */
    sum += p;
    if (fabs(yaw_of(apart)) > OTHER) other += p;
  }
  s->doubt = other / sum;
  const double *P = s->own[best], *x = P + DLKF_HEADING_OWN_P; /* p, v, C one behind the other */
  const double yaw_std = hypot(OVERBOUND * sqrt(P[8 * 15 + 8] > 0 ? P[8 * 15 + 8] : 0), SIDESLIP_STD);
  const int enough = s->epochs * EPOCH_S >= DLKF_SEARCH_S;
  if (!(s->weighed && s->doubt < 1 / (1 + exp(DECIDED)) && (enough || yaw_std <= READY_STD))) return 0;
  double *frame = d->work + DLKF_WORK - DLKF_HEADING;
  dlkf_heading_start(s->start, d->lever_arm_b, frame, d->work);
  const double *origin_e = frame + DLKF_HEADING_AT_ORIGIN, *C_en = frame + DLKF_HEADING_AT_AXES;
  apply3(C_en, x, r_e);
  for (int c = 0; c < 3; c++) r_e[c] += origin_e[c];
  apply3(C_en, x + 3, v_e);
  product3(C_en, chosen, C_eb);
  geodetic_from_ecef(r_e, &start[0], &start[1], &start[2]);
  ned_axes(start[0], start[1], C_new);
  apply3_transposed(C_new, v_e, start + 3);
  product3_transposed(C_new, C_eb, start + 6);
  for (int k = 0; k < 8; k++) start[15 + k] = sqrt(P[k * 15 + k]);
  start[15 + 8] = yaw_std;
  for (int c = 0; c < 3; c++) {
    const double std = BIAS_OVERBOUND * sqrt(P[(12 + c) * 15 + 12 + c]);
    start[24 + c] = s->own[best][DLKF_HEADING_OWN_BIAS + 3 + c];
    start[27 + c] = std > LEAST_BIAS_STD ? std : LEAST_BIAS_STD;
  }
  for (int k = 0; k < 2; k++) start[30 + k] = s->start[30 + k];
  return 1;
}
#else
typedef int dlkf_no_search;
#endif
