/* The core: fixes to their boundaries, update intervals, what comes late (dlkf.running.streaming). */
#include "dlkf.h"

#include <math.h>
#include <string.h>

#include "constants.h"
#include "geometry.h"

static const double EPOCH_S = DLKF_SAMPLES / DLKF_RATE_HZ, DEGREE = PI / 180;
static const double DEFAULT_STD[QUALITIES][6] = DEFAULT_STD_ROWS; /* 0: no satellite fix */

const size_t dlkf_bytes = sizeof(dlkf);
const int dlkf_columns = DLKF_COLUMNS, dlkf_search_seconds = DLKF_SEARCH_S;

dlkf_status dlkf_counted(dlkf *d, dlkf_status status) {
  d->counts[status]++;
  return status;
}

static dlkf_report *report_at(dlkf *d, int k) { return &d->reports[(d->report_first + k) % DLKF_EARLY]; }

static dlkf_epoch *epoch_at(dlkf *d, int64_t number) { return &d->closed[number % DLKF_CLOSED]; }

static void clear(dlkf *d) {
  for (int k = 0; k < DLKF_BOUNDARIES; k++) d->fixes[k].number = -1;
  d->report_first = d->report_count = 0;
  dlkf_screen_clear(&d->screen);
  dlkf_screen_clear(&d->screen_before);
  d->oldest = 0;
  d->kind = DLKF_NOTHING;
  d->latest = 0;
  d->doubt = 1;
  dlkf_aids_clear(d);
  dlkf_samples_clear(&d->samples);
}

void dlkf_open(dlkf *d, const double *lever_arm_b) {
  memset(d, 0, sizeof *d);
  d->layout = DLKF_LAYOUT;
  for (int k = 0; k < 3; k++) d->lever_arm_b[k] = lever_arm_b ? lever_arm_b[k] : 0;
  d->samples.phase_s = d->samples.step_s = NAN;
  clear(d);
}

void dlkf_lay(dlkf *d, double t, double step_s) {
  d->samples.phase_s = isfinite(t) ? t : (double)NAN;
  d->samples.step_s = step_s > 0 && step_s < EPOCH_S ? step_s : (double)NAN;
  clear(d);
}

int dlkf_fits(const dlkf *d) { return d->layout == DLKF_LAYOUT; }

const dlkf_fix *dlkf_fix_at(const dlkf *d, int64_t boundary) {
  if (boundary < 0) return NULL;
  const dlkf_fix *fix = &d->fixes[boundary % DLKF_BOUNDARIES];
  return fix->number == boundary ? fix : NULL;
}

/* The fix of a boundary in a tangent frame: value, 1-sigma, what may be used, lag (19 numbers). */
void dlkf_read_fix(const dlkf *d, int64_t boundary, const double *origin_e, const double *C_en, double *out) {
  const dlkf_fix *fix = dlkf_fix_at(d, boundary);
  memset(out, 0, 19 * sizeof *out);
  for (int k = 0; k < 6; k++) out[6 + k] = 1;
  if (!fix) return;
  double away[3], value[6];
  for (int k = 0; k < 3; k++) away[k] = fix->r_e[k] - origin_e[k];
  apply3_transposed(C_en, away, value);
  apply3_transposed(C_en, fix->v_e, value + 3);
  for (int k = 0; k < 6; k++) {
    out[k] = fix->used[k] ? value[k] : 0;
    out[6 + k] = fix->std[k];
    out[12 + k] = fix->used[k];
  }
  out[18] = fix->lag;
}

static dlkf_before *before(dlkf *d, int64_t number) { return &d->before[number % DLKF_REWIND]; }

static void copy_state(dlkf_state *to, const dlkf_state *from, int kind) {
  if (kind == DLKF_FILTER) memcpy(to->filter, from->filter, sizeof from->filter);
#if DLKF_SEARCH_S > 0
  if (kind == DLKF_SEARCH) to->search = from->search;
#endif
}

static void begin_filter(dlkf *d, const double *start) {
  dlkf_start(start, d->lever_arm_b, d->now.filter, d->work);
  d->kind = DLKF_FILTER;
  memset(&d->watch, 0, sizeof d->watch);
}

/* No filter after an update interval. */
static void end_filter(dlkf *d, int64_t number, dlkf_status status) {
  d->counts[status]++;
  before(d, number)->ended = (int32_t)status;
  d->kind = DLKF_NOTHING;
  d->latest = 0;
}

/* Align at the start of a closed update interval, or search over it; whether there is a filter for it. */
static int aligned(dlkf *d, int64_t number) {
  double start[DLKF_START];
#if DLKF_SEARCH_S > 0
  double doubt;
  if (d->kind == DLKF_NOTHING) {
    if (!dlkf_search_begin(d, number)) return 0;
    if (dlkf_search_start(d, start)) {
      doubt = d->now.search.doubt;
      begin_filter(d, start);
      d->doubt = doubt;
      return 1;
    }
    d->kind = DLKF_SEARCH;
  }
  if (!dlkf_search_advance(d, epoch_at(d, number)->imu, number + 1)) {
    end_filter(d, number, DLKF_DIVERGED);
  } else if (dlkf_search_start(d, start)) {
    doubt = d->now.search.doubt;
    begin_filter(d, start);
    d->doubt = doubt;
  }
  return 0;
#else
  double force_b[3], scatter[2];
  if (!dlkf_align(d, number, start, force_b, scatter)) return 0;
  begin_filter(d, start);
  d->doubt = 0;
  return 1;
#endif
}

/* The filter over a closed update interval: align at its start if need be, then one turn of the loop. */
static void run(dlkf *d, int64_t number, int revised) {
  dlkf_epoch *epoch = epoch_at(d, number);
  dlkf_before *held = before(d, number);
  double fix[DLKF_FIX];
  if (revised && held->ended) d->counts[held->ended]--; /* an update interval that is run again counts once */
  held->ended = 0;
  held->watch = d->watch;
  held->doubt = d->doubt;
  held->kind = d->kind;
  copy_state(&held->state, &d->now, d->kind);
  double *memory = d->now.filter, *begin = held->state.filter;
  if (d->kind != DLKF_FILTER) {
    if (!aligned(d, number)) return;
    begin = d->work + DLKF_WORK - DLKF_MEMORY;
    memcpy(begin, memory, DLKF_MEMORY * sizeof *memory);
  }
  dlkf_read_fix(d, number + 1, memory + DLKF_AT_ORIGIN, memory + DLKF_AT_AXES, fix);
  dlkf_read_aids(d, number + 1, fix + 19);
  dlkf_turn(begin, epoch->imu, fix, memory, d->outputs, d->work);
  double sum = 0;
  for (int k = 0; k < 15; k++) sum += d->outputs[DLKF_OUTPUTS_POSTERIOR + k];
  const int finite = isfinite(sum);
  if (!finite || dlkf_lost(d, number, fix)) {
    end_filter(d, number, finite ? DLKF_LOST : DLKF_DIVERGED);
    return;
  }
  double *row = d->rows[d->made++];
  dlkf_row(memory, d->outputs, row + DLKF_LAT_DEG, d->work);
  row[DLKF_T] = dlkf_samples_boundary(&d->samples, number + 1);
  row[DLKF_REVISED] = revised;
  memcpy(d->last, row, sizeof d->last);
  d->latest = 1;
  if (row[DLKF_FROM_ORIGIN_M] > DLKF_ANCHOR_M) {
    begin = d->work + DLKF_WORK - DLKF_MEMORY;
    memcpy(begin, memory, DLKF_MEMORY * sizeof *memory);
    dlkf_anchor(begin, memory, d->work);
  }
}

static int same_place(const dlkf_report *a, const dlkf_report *b) {
  return !(a->lat_deg < b->lat_deg || a->lat_deg > b->lat_deg || a->lon_deg < b->lon_deg || a->lon_deg > b->lon_deg ||
           a->height_m < b->height_m || a->height_m > b->height_m);
}

/* The fix of a boundary: the latest report of its update interval that the screen takes and that does not repeat the
 * position before, or none. */
static void put_fix(dlkf *d, int64_t row) {
  dlkf_fix *fix = &d->fixes[row % DLKF_BOUNDARIES];
  const dlkf_report *x = NULL;
  for (int k = 0; k < d->report_count; k++) {
    const dlkf_report *one = report_at(d, k);
    if (one->used && (int64_t)dlkf_samples_place(&d->samples, one->t) == row && !(x && same_place(x, one))) x = one;
  }
  if (!x) {
    if (fix->number == row) fix->number = -1;
    return;
  }
  double C_en[9], v_n[3];
  const double lat = x->lat_deg * DEGREE, lon = x->lon_deg * DEGREE;
  ecef_from_geodetic(lat, lon, x->height_m, fix->r_e);
  ned_axes(lat, lon, C_en);
  for (int k = 0; k < 6; k++) {
    const double std = x->std[k]; /* NaN and 0 are not known */
    fix->std[k] = !(std > 0) ? DEFAULT_STD[x->quality][k] : std > SMALLEST_STD ? std : SMALLEST_STD;
    fix->used[k] = k < 3 || !isnan(x->v[k - 3]);
  }
  for (int k = 0; k < 3; k++) v_n[k] = fix->used[3 + k] ? x->v[k] : 0;
  apply3(C_en, v_n, fix->v_e);
  const double lag = dlkf_samples_boundary(&d->samples, row) - x->t;
  fix->lag = lag > ON_BOUNDARY_S ? lag : 0;
  fix->t = x->t;
  fix->number = row;
}

/* Insert a fix among those held, which are in order of time, and screen it; where it is not the latest, screen all of them
 * again (dlkf.running.fix_history). The fix, and the first boundary whose fix has changed. */
static dlkf_report *screened(dlkf *d, const dlkf_report *x, int place, int64_t *changed) {
  const double oldest = (double)(d->samples.epochs - DLKF_REWIND);
  while (d->report_count && (d->report_count == DLKF_EARLY || dlkf_samples_place(&d->samples, report_at(d, 0)->t) < oldest)) {
    (void)dlkf_screen_take(&d->screen_before, report_at(d, 0));
    d->report_first = (d->report_first + 1) % DLKF_EARLY;
    d->report_count--;
    place -= place > 0;
  }
  for (int k = d->report_count++; k > place; k--) *report_at(d, k) = *report_at(d, k - 1);
  *report_at(d, place) = *x;
  int k = place;
  if (place < d->report_count - 1) d->screen = d->screen_before, k = 0;
  for (; k < d->report_count; k++) {
    dlkf_report *one = report_at(d, k);
    const int used = dlkf_screen_take(&d->screen, one);
    if (used == one->used) continue;
    one->used = used;
    const int64_t row = (int64_t)dlkf_samples_place(&d->samples, one->t);
    put_fix(d, row);
    if (row < *changed) *changed = row;
  }
  return report_at(d, place);
}

/* A fix to its boundary; what is over is run anew. */
static dlkf_status file(dlkf *d, const dlkf_report *x) {
  const double place = dlkf_samples_place(&d->samples, x->t);
  const dlkf_status timing = dlkf_samples_timing(&d->samples, place, FIRST_OF_FIXES);
  if (timing != DLKF_TAKEN) return dlkf_counted(d, timing);
  int k = d->report_count;
  while (k > 0 && report_at(d, k - 1)->t > x->t) k--;
  if (k > 0 && report_at(d, k - 1)->t >= x->t) return dlkf_counted(d, DLKF_DOUBLE);
  int64_t changed = INT64_MAX;
  const int used = screened(d, x, k, &changed)->used, replayed = dlkf_replay(d, changed);
  if (!used) return dlkf_counted(d, DLKF_IMPLAUSIBLE_FIX);
  if (d->fixes[(int64_t)place % DLKF_BOUNDARIES].t > x->t) return dlkf_counted(d, DLKF_SUPERSEDED);
  return dlkf_counted(d, replayed ? DLKF_REPLAYED : DLKF_TAKEN);
}

/* The filter again from the update interval on that ends at a boundary; 0 where that is still to come. */
int dlkf_replay(dlkf *d, int64_t row) {
  const int64_t done = d->samples.epochs, from = row - 1 > d->oldest ? row - 1 : d->oldest;
  if (row > done || done == d->oldest) return 0;
  const dlkf_before *held = before(d, from);
  d->kind = held->kind;
  d->watch = held->watch;
  d->doubt = held->doubt;
  copy_state(&d->now, &held->state, held->kind);
  for (int64_t k = from; k < done; k++) run(d, k, 1);
  return 1;
}

/* Lay the grid, once there are fixes enough to lay it through. */
static void settle(dlkf *d) {
  double *through = d->work; /* of the filter, which does not run yet */
  int n = 0;
  if (!isnan(d->samples.phase_s)) {
    through[n++] = d->samples.phase_s;
  } else {
    const double now = dlkf_samples_latest(&d->samples);
    for (int k = 0; k < d->report_count; k++) {
      const double t = report_at(d, k)->t;
      if (!(fabs(t - now) <= DLKF_LATE_S + SETTLE_S)) continue;
      int j = n++;
      for (; j > 0 && through[j - 1] > t; j--) through[j] = through[j - 1];
      through[j] = t;
    }
    if (n < 2 || through[n - 1] - through[0] < SETTLE_S - ON_BOUNDARY_S) return;
  }
  if (!dlkf_samples_begin(&d->samples, through, n)) return;
  const int count = d->report_count;
  d->report_count = 0;
  for (int k = 0; k < count; k++) { /* the same ring, filled from its beginning with those already read;
                                    * what lies before the first update interval is of no use, which is no fault of it */
    const dlkf_report x = *report_at(d, k);
    if (dlkf_samples_place(&d->samples, x.t) >= FIRST_OF_FIXES) file(d, &x);
  }
  dlkf_aids_file(d);
}

/* Over update intervals with a gap of the IMU, from their samples together: nothing before can be replayed any more. */
static void bridge(dlkf *d, const double *imu, int64_t count, const double seconds[3]) {
  const int64_t number = d->samples.epochs;
  d->oldest = number;
  if (d->kind != DLKF_FILTER || !d->latest) { /* a late fix has ended it */
    d->kind = DLKF_NOTHING;
    d->latest = 0;
    return;
  }
  const double share = (double)count;
  double *before = d->work + DLKF_WORK - DLKF_MEMORY, outputs[DLKF_OUTPUTS];
  dlkf_carry(d->now.filter, imu, &share, d->outputs, outputs, d->work);
  memcpy(before, d->now.filter, sizeof d->now.filter);
  dlkf_bridge(before, seconds, outputs, d->now.filter, d->outputs, d->work);
  double *row = d->rows[d->made++];
  dlkf_row(d->now.filter, d->outputs, row + DLKF_LAT_DEG, d->work);
  row[DLKF_T] = dlkf_samples_boundary(&d->samples, number);
  row[DLKF_REVISED] = 0;
  memcpy(d->last, row, sizeof d->last);
}

static void close_epochs(dlkf *d, int ended) {
  for (;;) {
    const int64_t number = d->samples.epochs;
    double seconds[3], *imu = epoch_at(d, number)->imu;
    const int64_t count = dlkf_samples_closed(&d->samples, ended, imu, seconds);
    if (!count) return;
    if (!isnan(seconds[1])) {
      bridge(d, imu, count, seconds);
      continue;
    }
    run(d, number, 0);
    if (number + 1 - d->oldest > DLKF_REWIND + DLKF_LOOKBACK) {
      dlkf_fix *fix = &d->fixes[d->oldest % DLKF_BOUNDARIES];
      if (fix->number == d->oldest) fix->number = -1;
      d->oldest++;
    }
  }
}

dlkf_status dlkf_imu(dlkf *d, double t, const double accel[3], const double gyro[3]) {
  d->made = d->given = 0;
  const int64_t spiked = d->samples.spiked;
  const double *v = d->last + DLKF_VEL_N;
  const int moves = d->latest && v[0] * v[0] + v[1] * v[1] + v[2] * v[2] > FROZEN_SPEED_M_S * FROZEN_SPEED_M_S;
  const int runs = DLKF_BRIDGES && d->kind == DLKF_FILTER && d->latest;
  const dlkf_status status = dlkf_samples_take(&d->samples, t, accel, gyro, moves, runs);
  d->counts[DLKF_SPIKE] += d->samples.spiked - spiked;
  if (status == DLKF_BRIDGED) (void)dlkf_counted(d, status);
  else if (status != DLKF_TAKEN) {
    if (!dlkf_samples_lost(&d->samples)) return dlkf_counted(d, status);
    clear(d);
    return dlkf_counted(d, DLKF_RESTARTED);
  }
  if (isnan(d->samples.t0)) settle(d);
  if (!isnan(d->samples.t0)) close_epochs(d, 0);
  return status;
}

void dlkf_finish(dlkf *d) {
  d->made = d->given = 0;
  if (!isnan(d->samples.t0)) close_epochs(d, 1);
}

dlkf_status dlkf_gnss(dlkf *d, double t, double lat_deg, double lon_deg, double height_m, const double *velocity_ned,
                      const double *std, int quality) {
  d->made = d->given = 0;
  dlkf_report x = {t, lat_deg, lon_deg, height_m, {NAN, NAN, NAN}, {NAN, NAN, NAN, NAN, NAN, NAN}, quality, 0};
  if (velocity_ned) memcpy(x.v, velocity_ned, sizeof x.v);
  if (std) memcpy(x.std, std, sizeof x.std);
  int infinite = isinf(lat_deg) || isinf(lon_deg) || isinf(height_m) || !isfinite(t), below = 0;
  for (int k = 0; k < 3; k++) infinite |= isinf(x.v[k]) != 0;
  for (int k = 0; k < 6; k++) infinite |= isinf(x.std[k]) != 0, below |= x.std[k] < 0;
  if (infinite) return dlkf_counted(d, DLKF_NOT_FINITE);
  if (quality < 0 || quality >= QUALITIES || !(DEFAULT_STD[quality][0] > 0) || isnan(lat_deg + lon_deg + height_m))
    return dlkf_counted(d, DLKF_NO_FIX);
  if (fabs(lat_deg) > 90 || fabs(lon_deg) > 180 || below) return dlkf_counted(d, DLKF_OUTSIDE);
  if (!isnan(d->samples.t0)) return file(d, &x);
  if (d->report_count == DLKF_EARLY) d->report_first = (d->report_first + 1) % DLKF_EARLY, d->report_count--;
  *report_at(d, d->report_count++) = x;
  return dlkf_counted(d, DLKF_TAKEN);
}

const double *dlkf_next(dlkf *d) { return d->given < d->made ? d->rows[d->given++] : NULL; }

dlkf_waiting dlkf_waits(const dlkf *d) {
  if (d->kind == DLKF_FILTER && d->latest) return DLKF_RUNS;
  if (!d->samples.count) return DLKF_WAITS_FOR_SAMPLES;
  if (d->kind != DLKF_NOTHING) return DLKF_WAITS_FOR_HEADING;
  return isnan(d->samples.t0) ? DLKF_WAITS_FOR_FIXES : DLKF_WAITS_FOR_MOTION;
}

dlkf_waiting dlkf_pose(dlkf *d, double *row) {
  double outputs[DLKF_OUTPUTS];
  const dlkf_waiting waiting = dlkf_waits(d);
  if (waiting != DLKF_RUNS) return waiting;
  double *imu = d->work + DLKF_WORK - DLKF_SAMPLES * 6;
  const double span = dlkf_samples_open(&d->samples, imu);
  memcpy(row, d->last, sizeof d->last);
  if (!(span > 0)) return DLKF_RUNS;
  const double share = span / EPOCH_S;
  dlkf_carry(d->now.filter, imu, &share, d->outputs, outputs, d->work);
  dlkf_row(d->now.filter, outputs, row + DLKF_LAT_DEG, d->work);
  row[DLKF_T] = dlkf_samples_settled(&d->samples);
  row[DLKF_GNSS_USED] = row[DLKF_REVISED] = 0;
  return DLKF_RUNS;
}

double dlkf_doubt(const dlkf *d) {
#if DLKF_SEARCH_S > 0
  if (d->kind == DLKF_SEARCH) return d->now.search.doubt;
#endif
  return d->kind == DLKF_FILTER ? d->doubt : 1;
}

int64_t dlkf_count(const dlkf *d, dlkf_status status) {
  return (unsigned)status < DLKF_STATUSES ? d->counts[status] : 0;
}

const char *dlkf_says(dlkf_status status) {
  static const char *const words[DLKF_STATUSES] = {
      "taken", "taken late, and replayed", "superseded by a later one of the same update interval",
      "refused: a number is not finite", "refused: beyond full scale", "refused: duplicate stamp",
      "refused: the stamp is before the last one", "refused: a gap before the stamp", "refused: more samples than the memory holds",
      "refused: no fix", "refused: latitude, longitude or 1-sigma out of range", "refused: not reachable since the last good fix", "refused: too late",
      "refused: ahead of the IMU; both need one clock", "refused: this filter takes no such sensor", "restarted: stamps were inconsistent for a second",
      "the filter diverged and realigns", "the filter was far from good fixes and realigns", "an isolated spike of the IMU, left out",
      "refused: the IMU repeats the same sample while the car moves", "taken after a gap, over which the filter was carried"};
  return (unsigned)status < DLKF_STATUSES ? words[status] : "no such status";
}

const char *dlkf_waits_for(dlkf_waiting waiting) {
  static const char *const words[] = {"nothing", "samples of the IMU", "fixes over 3 seconds",
                                      "the car to move under GNSS, with velocities at most 5 s or positions at most 2.5 s apart",
                                      "motion that determines the heading"};
  return (unsigned)waiting < sizeof words / sizeof *words ? words[waiting] : "no such thing";
}
