/* IMU samples one at a time, brought to the grid of update intervals (dlkf.running.imu_stream, dlkf.data.resampling). */
#include <math.h>
#include <string.h>

#include "constants.h"
#include "dlkf.h"

static const double EPOCH_S = DLKF_SAMPLES / DLKF_RATE_HZ;

static const dlkf_sample *at(const dlkf_samples *s, int k) { return &s->ring[(s->first + k) % DLKF_RAW]; }

static void drop(dlkf_samples *s) {
  s->first = (s->first + 1) % DLKF_RAW;
  s->count--;
}

static double longest(double usual) {
  const double some = isnan(usual) ? 0 : GAP_SAMPLES * usual;
  return some > GAP_S ? some : GAP_S;
}

static double ulp(double x) { return nextafter(fabs(x), INFINITY) - fabs(x); }

void dlkf_samples_clear(dlkf_samples *s) {
  s->first = s->count = 0;
  s->spiked = 0;
  memset(&s->spikes, 0, sizeof s->spikes);
  s->astray[0] = s->astray[1] = s->t0 = s->since[0] = s->since[1] = NAN;
  s->step = s->step_s;
  s->longest = longest(s->step_s);
  s->epochs = 0;
  s->until = 1;
  s->after_count = 0;
  s->usual_s = s->missing = 0;
  s->gap[0] = s->gap[1] = NAN;
}

double dlkf_samples_latest(const dlkf_samples *s) { return s->count ? at(s, s->count - 1)->t : -(double)INFINITY; }

/* Stamp of the last sample that can no longer prove to be a spike. */
double dlkf_samples_settled(const dlkf_samples *s) {
  const int k = s->count - 1 - s->spikes.undecided;
  return k < 0 ? -(double)INFINITY : at(s, k)->t;
}

double dlkf_samples_boundary(const dlkf_samples *s, int64_t number) { return s->t0 + (double)number * EPOCH_S; }

/* Number of the first boundary at or after a stamp, whatever it is. */
double dlkf_samples_place(const dlkf_samples *s, double t) { return ceil((t - s->t0 - ON_BOUNDARY_S) / EPOCH_S); }

/* Whether what counts at a boundary, of which `least` is the first, comes in time. */
dlkf_status dlkf_samples_timing(const dlkf_samples *s, double place, int least) {
  if (!(place < (double)(s->until + DLKF_REWIND))) return DLKF_AHEAD;
  if (place < least || (place > 1 ? place - 1 : 0) < (double)(s->epochs - DLKF_REWIND)) return DLKF_LATE;
  return DLKF_TAKEN;
}

/* Samples out of line have gone on for longer than an accident does: the clock was set, or the gap is real. */
int dlkf_samples_lost(const dlkf_samples *s) { return s->astray[1] - s->astray[0] >= ASTRAY_S; }

/* A sample in line; of `usual` it counts as much as it is long. */
static void append(dlkf_samples *s, const dlkf_sample *x) {
  const double step = s->count ? x->t - dlkf_samples_latest(s) : s->usual_s;
  s->usual_s = s->usual_s + step < USUAL_S ? s->usual_s + step : USUAL_S;
  const double share = s->usual_s > 0 ? step / s->usual_s : 1;
  for (int k = 0; k < 6; k++) s->usual[k] += share * (x->x[k] - s->usual[k]);
  s->ring[(s->first + s->count++) % DLKF_RAW] = *x;
  if (!dlkf_spikes_add(&s->spikes, x->x)) return;
  for (int k = s->count - 1 - DLKF_SPIKE_AHEAD; k < s->count - 1; k++) s->ring[(s->first + k) % DLKF_RAW] = *at(s, k + 1);
  s->count--;
  s->spiked++;
}

/* Fill the gap up to the samples that have come after it (dlkf.running.bridging); 0 where it is not to be filled. */
static int fill(dlkf_samples *s, double last) {
  const double first = s->after[0].t, missing = first - s->step - last;
  if (isnan(s->t0) || first <= last || s->missing + missing > LONGEST_BRIDGE_S) return 0;
  const double wanted = rint((first - last) / s->step) - 1;
  const int count = wanted > 1 ? (int)wanted : 1, known = s->count < DLKF_AFTER_GAP ? s->count : DLKF_AFTER_GAP;
  if (s->count + count + DLKF_AFTER_GAP > DLKF_RAW) return 0;
  double mean[2][6] = {{0}};
  for (int c = 0; c < 6; c++) {
    for (int k = 0; k < known; k++) mean[0][c] += at(s, s->count - known + k)->x[c] / known;
    for (int k = 0; k < DLKF_AFTER_GAP; k++) mean[1][c] += s->after[k].x[c] / DLKF_AFTER_GAP;
  }
  for (int k = 1; k <= count; k++) {
    const double share = (double)k / (count + 1);
    dlkf_sample *x = &s->ring[(s->first + s->count++) % DLKF_RAW];
    x->t = last + k * ((first - last) / (count + 1));
    for (int c = 0; c < 6; c++) /* vertical force, roll and pitch rate as usual */
      x->x[c] = c < 2 || c > 4 ? mean[0][c] + share * (mean[1][c] - mean[0][c]) : s->usual[c];
  }
  memset(&s->spikes, 0, sizeof s->spikes);
  if (isnan(s->gap[0])) s->gap[0] = last;
  s->gap[1] = first - s->step;
  s->missing += missing;
  for (int k = 0; k < DLKF_AFTER_GAP; k++) append(s, &s->after[k]);
  const int64_t reached = (int64_t)ceil((s->gap[1] - s->t0) / EPOCH_S - 1e-9);
  if (reached > s->until) s->until = reached;
  s->astray[0] = s->astray[1] = NAN;
  return 1;
}

static dlkf_status out_of_line(dlkf_samples *s, const dlkf_sample *x, double last, int runs) {
  const int follows = s->astray[1] < x->t && x->t <= s->astray[1] + s->longest;
  if (!follows) s->astray[0] = x->t, s->after_count = 0;
  s->astray[1] = x->t;
  if (s->after_count < DLKF_AFTER_GAP) s->after[s->after_count++] = *x;
  if (!(x->t > last)) return x->t < last ? DLKF_BACK : DLKF_DOUBLE;
  return s->after_count == DLKF_AFTER_GAP && runs && fill(s, last) ? DLKF_BRIDGED : DLKF_GAP;
}

/* Whether all six numbers have been the same for longer than a working sensor repeats them. */
static int repeats(dlkf_samples *s, const dlkf_sample *x) {
  int same = x->t >= s->since[1] && x->t - s->since[1] <= s->longest;
  for (int k = 0; k < 6; k++) same &= x->x[k] >= s->same[k] && x->x[k] <= s->same[k];
  if (!same) {
    memcpy(s->same, x->x, sizeof s->same);
    s->since[0] = x->t;
  }
  s->since[1] = x->t;
  return x->t - s->since[0] > FROZEN_IMU_S;
}

dlkf_status dlkf_samples_take(dlkf_samples *s, double t, const double accel[3], const double gyro[3], int moves, int runs) {
  dlkf_sample sample = {t, {accel[0], accel[1], accel[2], gyro[0], gyro[1], gyro[2]}};
  double sum = t;
  for (int k = 0; k < 6; k++) sum += sample.x[k];
  if (!isfinite(sum)) return DLKF_NOT_FINITE;
  for (int k = 0; k < 6; k++)
    if (fabs(sample.x[k]) > (k < 3 ? FULL_SCALE_ACCEL : FULL_SCALE_GYRO)) return DLKF_IMPLAUSIBLE;
  if (repeats(s, &sample) && moves) return DLKF_FROZEN;
  const double last = dlkf_samples_latest(s);
  if (s->count && !(last < t && t <= last + s->longest)) return out_of_line(s, &sample, last, runs);
  if (s->count == DLKF_RAW) {
    if (!isnan(s->t0) || t - at(s, 0)->t < EPOCH_S) return DLKF_FULL;
    drop(s);
  }
  s->astray[0] = s->astray[1] = NAN;
  append(s, &sample);
  if (isnan(s->t0) && t - at(s, 0)->t > DLKF_KEEP_S) drop(s);
  return DLKF_TAKEN;
}

/* The k-th smallest interval between samples, by halving the range of its bits: needs no memory. */
static double interval(const dlkf_samples *s, int k) {
  uint64_t low = 0, high = UINT64_C(0x7FF0000000000000);
  while (low < high) {
    const uint64_t middle = low + (high - low) / 2;
    double x;
    memcpy(&x, &middle, sizeof x);
    int below = 0;
    for (int j = 1; j < s->count; j++) below += at(s, j)->t - at(s, j - 1)->t <= x;
    if (below > k) high = middle;
    else low = middle + 1;
  }
  double x;
  memcpy(&x, &high, sizeof x);
  return x;
}

static double usual_interval(const dlkf_samples *s) {
  const int n = s->count - 1;
  return n % 2 ? interval(s, n / 2) : 0.5 * (interval(s, n / 2 - 1) + interval(s, n / 2));
}

static double wrapped(double x, double period) {
  const double rest = fmod(x, period);
  return rest < 0 ? rest + period : rest;
}

static void sort(double *x, int n) {
  for (int i = 1; i < n; i++) {
    const double value = x[i];
    int j = i;
    for (; j > 0 && x[j - 1] > value; j--) x[j] = x[j - 1];
    x[j] = value;
  }
}

static double median(const double *sorted, int n) { return 0.5 * (sorted[(n - 1) / 2] + sorted[n / 2]); }

/* Phase of fixes (in order of time) in an update interval (dlkf.data.resampling.fix_phase). */
static double fix_phase(const double *t, int n) {
  double c = 0, s = 0, around[DLKF_EARLY];
  for (int k = 0; k < n; k++) {
    const double angle = 2 * PI * (wrapped(t[k], EPOCH_S) / EPOCH_S);
    c += cos(angle) / n;
    s += sin(angle) / n;
  }
  const int together = hypot(c, s) > 0.5;
  const double centre = together ? atan2(s, c) / (2 * PI) * EPOCH_S : wrapped(t[0], EPOCH_S);
  for (int k = 0; k < n; k++)
    around[k] = wrapped(wrapped(t[k], EPOCH_S) - centre + EPOCH_S / 2, EPOCH_S) - EPOCH_S / 2;
  sort(around, n);
  if (together) {
    const double middle = median(around, n);
    int close = 0;
    for (int k = 0; k < n; k++) close += fabs(around[k] - middle) <= ON_BOUNDARY_S;
    if (2 * close > n) return centre + middle;
    const double place = 0.95 * (n - 1);
    const int low = (int)place;
    const double next = around[low + 1 < n ? low + 1 : low];
    return centre + around[low] + (next - around[low]) * (place - low);
  }
  int most = 0, count = 0;
  double best = 0;
  for (int k = 0; k < n; k++) { /* the most frequent millisecond, the first of several */
    count = k && rint(around[k] / ON_BOUNDARY_S) == rint(around[k - 1] / ON_BOUNDARY_S) ? count + 1 : 1;
    if (count > most) most = count, best = rint(around[k] / ON_BOUNDARY_S) * ON_BOUNDARY_S;
  }
  int first = 0, last = n;
  while (fabs(around[first] - best) > ON_BOUNDARY_S) first++;
  while (fabs(around[last - 1] - best) > ON_BOUNDARY_S) last--;
  return centre + median(around + first, last - first);
}

/* Lay the grid through times of fixes, sorted; 0 while there is less than an update interval of samples. */
int dlkf_samples_begin(dlkf_samples *s, const double *t_fix, int count) {
  if (s->count < 2) return 0;
  const double begin = at(s, 0)->t, last = dlkf_samples_latest(s);
  if (last - begin + 2 * s->longest < EPOCH_S) return 0;
  const double found = usual_interval(s), spacing = EPOCH_S / DLKF_SAMPLES;
  const double slack = 0.5 * (found < spacing ? found : spacing), phase = fix_phase(t_fix, count);
  const double t0 = phase + ceil((begin - found - phase - slack) / EPOCH_S) * EPOCH_S;
  if (!(floor((last - t0 + slack) / EPOCH_S) >= 1)) return 0;
  s->t0 = t0;
  s->step = isnan(s->step_s) ? found : s->step_s;
  s->longest = longest(s->step);
  return 1;
}

static double slack(const dlkf_samples *s) {
  const double spacing = EPOCH_S / DLKF_SAMPLES;
  return 0.5 * (s->step < spacing ? s->step : spacing);
}

/* alpha0 x nu + nu0 x alpha, and alpha0 x alpha, of increments (nu [m/s], alpha [rad]) one after the other, added to out
 * times a factor (dlkf.data.increments) */
static void second_order(const double *before, const double *now, double factor, double *out) {
  for (int k = 0; k < 3; k++) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    out[k] += factor * (before[3 + i] * now[j] - before[3 + j] * now[i] + before[i] * now[3 + j] - before[j] * now[3 + i]);
    out[3 + k] += factor * (before[3 + i] * now[3 + j] - before[3 + j] * now[3 + i]);
  }
}

/* Integral of sample k of those from `first` on over its interval; where stamps are missing in it, the mean of the two
 * neighbours fills the missing part. */
static int integral(const dlkf_samples *s, int first, int k, double *step, double *out) {
  const double *now = at(s, k)->x;
  *step = k > first ? at(s, k)->t - at(s, k - 1)->t : s->step;
  const int whole = k == first || *step <= 1.5 * s->step;
  for (int c = 0; c < 6; c++) {
    out[c] = now[c] * (whole ? *step : s->step);
    if (!whole) out[c] += 0.5 * (now[c] + at(s, k - 1)->x[c]) * (*step - s->step);
  }
  return whole;
}

/* Rate and force of interval k that, constant over it, turn and push like the true ones: coning and sculling from the
 * interval before, rate and force taken as linear through both (Savage 1998). */
static void rates(const dlkf_samples *s, int first, int k, double *out) {
  double step, before[6], step0;
  const int whole = integral(s, first, k, &step, out);
  if (k > first && integral(s, first, k - 1, &step0, before) && whole) {
    double raw[6];
    memcpy(raw, out, sizeof raw);
    second_order(before, raw, step * step / (6 * step0 * (step0 + step)), out);
  }
  for (int c = 0; c < 6; c++) out[c] /= step;
}

/* `count` samples of equal length from `begin` over `span` seconds, constant in each, composed of the pieces of intervals
 * inside them (dlkf.data.resampling.resample_imu). */
static void resampled(const dlkf_samples *s, double begin, double span, int count, double *imu) {
  const double dt = span / count;
  int first = 0, end = 0;
  while (first < s->count && at(s, first)->t <= begin) first++;
  for (end = first; end < s->count && at(s, end)->t < begin + dt * count;) end++;
  first = first > BEFORE ? first - BEFORE : 0;
  end = end + 1 < s->count ? end + 1 : s->count;
  int k = first; /* interval that ends at sample k; the one beyond the last goes on with its values */
  double force[6];
  while (k < end && at(s, k)->t <= begin) k++;
  const double opening = at(s, first)->t - s->step;
  int early = begin < opening; /* one interval more before the first */
  if (early) memcpy(force, at(s, first)->x, sizeof force);
  else if (k < end) rates(s, first, k, force);
  else memcpy(force, at(s, end - 1)->x, sizeof force);
  double now = begin;
  for (int j = 0; j < count; j++) {
    const double limit = begin + dt * (j + 1);
    double total[6] = {0}, products[6] = {0};
    int pieces = 0;
    while (now < limit) {
      const double knot = early ? opening : k < end ? at(s, k)->t : (double)INFINITY;
      const double until = knot < limit ? knot : limit;
      double piece[6];
      for (int c = 0; c < 6; c++) piece[c] = force[c] * (until - now);
      if (pieces++) second_order(total, piece, 1, products);
      for (int c = 0; c < 6; c++) total[c] += piece[c];
      now = until;
      if (knot <= limit) {
        k += !early;
        early = 0;
        if (k < end) rates(s, first, k, force);
        else memcpy(force, at(s, end - 1)->x, sizeof force);
      }
    }
    for (int c = 0; c < 6; c++) imu[6 * j + c] = (total[c] + 0.5 * products[c]) / dt;
  }
}

/* How many update intervals have ended that the samples have reached: their samples, and where there is a gap in them (else
 * NAN) the seconds before, in and after it. Where the stream has ended, to half a sample, and the last are no spikes. */
int64_t dlkf_samples_closed(dlkf_samples *s, int ended, double *imu, double seconds[3]) {
  if (isnan(s->t0)) return 0;
  const double end = dlkf_samples_boundary(s, s->until), rounding = 4 * ulp(end);
  const double last = ended ? dlkf_samples_latest(s) : dlkf_samples_settled(s);
  if (!(last >= end - (ended && slack(s) > rounding ? slack(s) : rounding))) return 0;
  const int64_t count = s->until - s->epochs;
  const double begin = dlkf_samples_boundary(s, s->epochs);
  resampled(s, begin, (double)count * EPOCH_S, DLKF_SAMPLES, imu);
  seconds[0] = s->gap[0] - begin;
  seconds[1] = s->gap[1] - s->gap[0];
  seconds[2] = end - s->gap[1];
  s->gap[0] = s->gap[1] = NAN;
  s->missing = 0;
  s->epochs = s->until++;
  while (s->count > BEFORE && at(s, BEFORE)->t <= dlkf_samples_boundary(s, s->epochs)) drop(s);
  return count;
}

/* DLKF_SAMPLES samples from the open update interval's beginning to the last that can be no spike, and the seconds that they span. */
double dlkf_samples_open(const dlkf_samples *s, double *imu) {
  const double begin = dlkf_samples_boundary(s, s->epochs), span = dlkf_samples_settled(s) - begin;
  if (!(span > 4 * ulp(begin))) return 0;
  resampled(s, begin, span, DLKF_SAMPLES, imu);
  return span;
}
