/* Fixes one at a time, each compared with the last good one; what no car can have reached is refused (dlkf.data.limits). */
#include <math.h>
#include <string.h>

#include "constants.h"
#include "dlkf.h"

static double horizontal_distance(const dlkf_place *a, const dlkf_place *b) {
  const double one = a->lat_deg * PI / 180, two = b->lat_deg * PI / 180, s = sin((two - one) / 2);
  const double e = sin((b->lon_deg - a->lon_deg) * PI / 180 / 2);
  const double half = s * s + cos(one) * cos(two) * e * e;
  return 2 * EARTH_M * asin(sqrt(half < 0 ? 0 : half > 1 ? 1 : half));
}

static int reaches(const dlkf_place *a, const dlkf_place *b) {
  const double dt = fabs(b->t - a->t), slack = JUMP_M + JUMP_SIGMAS * (a->std_m + b->std_m);
  return horizontal_distance(a, b) <= FASTEST_M_S * dt + slack && fabs(b->height_m - a->height_m) <= STEEPEST_M_S * dt + slack;
}

static void take(dlkf_screen *s, const dlkf_place *fix) {
  s->good = *fix;
  if (s->count < AGREEING_FIXES) s->count++;
}

void dlkf_screen_clear(dlkf_screen *s) { s->count = s->others = s->known = 0; }

/* 1 for a fix that a car can have reached; it is then the good one. */
int dlkf_screen_take(dlkf_screen *s, const dlkf_report *x) {
  double speed = 0; /* by the components that are known */
  for (int k = 0; k < 3; k++) speed += isnan(x->v[k]) ? 0 : x->v[k] * x->v[k];
  speed = sqrt(speed);
  if (fabs(x->lat_deg) < NOWHERE_DEG && fabs(x->lon_deg) < NOWHERE_DEG) return 0;
  if (!(x->height_m >= LOWEST_M && x->height_m <= HIGHEST_M) || speed > FASTEST_M_S) return 0;
  double squares = 0;
  for (int k = 0; k < 6; k++) {
    if (x->std[k] > LARGEST_STD) return 0;
    if (k < 3 && !isnan(x->std[k])) squares += x->std[k] * x->std[k];
  }
  dlkf_place fix = {x->t, x->lat_deg, x->lon_deg, x->height_m, 0, x->t};
  fix.std_m = sqrt(squares) < MOST_JUMP_STD_M ? sqrt(squares) : MOST_JUMP_STD_M;
  if (!s->known) {
    s->known = 1;
    take(s, &fix);
    return 1;
  }
  if (reaches(&s->good, &fix)) {
    const int same = s->good.lat_deg >= fix.lat_deg && s->good.lat_deg <= fix.lat_deg &&
                     s->good.lon_deg >= fix.lon_deg && s->good.lon_deg <= fix.lon_deg;
    if (same) fix.since = s->good.since;
    if (same && speed > FROZEN_SPEED_M_S && speed * (fix.t - fix.since) > FROZEN_M) return 0;
    s->others = 0;
    if (fix.t >= s->good.t) take(s, &fix);
    return 1;
  }
  const int agrees = s->others && reaches(&s->other, &fix);
  s->others = agrees ? s->others + 1 : 1;
  if (!agrees) s->others_since = fix.t;
  s->other = fix;
  const int enough = s->others >= AGREEING_FIXES && fix.t - s->others_since >= AGREEING_S;
  if (!enough && s->count >= (s->others < AGREEING_FIXES ? s->others : AGREEING_FIXES)) return 0;
  s->count = s->others - 1;
  s->others = 0;
  take(s, &fix);
  return 1;
}

/* Fixes in a row that lie far off the filter, after one of an update interval that ends with `number`; 1 where they are
 * so many that the filter is lost, or its state is that of no car (dlkf.running.loss). */
int dlkf_lost(dlkf *d, int64_t number, const double *fix) {
  const double t = (double)number * (DLKF_SAMPLES / DLKF_RATE_HZ), *z = d->outputs + DLKF_OUTPUTS_INNOVATION;
  const dlkf_fix *held = dlkf_fix_at(d, number + 1);
  int repeated = held != NULL; /* a receiver that repeats its last position says nothing by it */
  for (int k = 0; repeated && k < 3; k++) repeated = held->r_e[k] >= d->watch.place[k] && held->r_e[k] <= d->watch.place[k];
  if (!repeated && (fix[12] > 0 || fix[13] > 0 || fix[14] > 0)) {
    const double std = sqrt(fix[6] * fix[6] + fix[7] * fix[7] + fix[8] * fix[8]) * LOST_SIGMAS;
    const double share = sqrt(z[0] * z[0] + z[1] * z[1] + z[2] * z[2]) / (std > LOST_M ? std : LOST_M);
    const int far = share > LOST_SHARE, first = far && !d->watch.count;
    double apart = 0, size = 0; /* from the last one of the row, which it has to agree with */
    for (int k = 0; k < 3; k++) {
      apart += (z[k] - d->watch.off[k]) * (z[k] - d->watch.off[k]);
      size += z[k] * z[k];
    }
    if (first) d->watch.since = t;
    if (!far) {
      d->watch.total = 0;
      d->watch.count = 0;
    } else if (first || !(sqrt(apart) > sqrt(size))) {
      d->watch.total += share < 1 ? share : 1;
      d->watch.count++;
    }
    for (int k = 0; k < 3; k++) d->watch.off[k] = z[k];
    if (held) memcpy(d->watch.place, held->r_e, sizeof d->watch.place);
  }
  const double *p = d->outputs + DLKF_OUTPUTS_POSTERIOR, *v = p + 3;
  const double height = d->now.filter[DLKF_AT_HEIGHT] - p[2] + (p[0] * p[0] + p[1] * p[1]) / 2 / EARTH_M;
  return (d->watch.total >= LOST_FIXES && (t - d->watch.since) * d->watch.total >= LOST_S * d->watch.count) ||
         sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) > ESTIMATE_M_S || height < ESTIMATE_LOWEST_M || height > ESTIMATE_HIGHEST_M;
}
