/* Samples of further sensors, reduced to one row for each update interval (dlkf.data.aids). */
#include <math.h>
#include <string.h>

#include "constants.h"
#include "dlkf.h"

static const char *const NAMES[DLKF_SENSORS] = DLKF_AID_NAMES;
static const int LAST[DLKF_SENSORS] = DLKF_AID_LAST;

int dlkf_sensor(const char *name) {
  for (int k = 0; k < DLKF_AIDS; k++)
    if (!strcmp(NAMES[k], name)) return k;
  return -1;
}

double dlkf_pressure_height(double pressure) { return SCALE_M * (1 - pow(pressure / SEA_LEVEL_PA, EXPONENT)); }

void dlkf_aids_clear(dlkf *d) {
  for (int s = 0; s < DLKF_SENSORS; s++) {
    for (int k = 0; k < DLKF_BOUNDARIES; k++) d->aids[s][k].number = -1;
    for (int k = 0; k < DLKF_STAMPS; k++) d->stamps[s][k] = NAN;
    d->stamp[s] = 0;
  }
  d->early_aid = d->early_aid_count = 0;
}

/* The row of each sensor at a boundary: mean or last value, 1-sigma (0: unknown), lag, span, count. */
void dlkf_read_aids(const dlkf *d, int64_t boundary, double *out) {
  for (int s = 0; s < DLKF_AIDS; s++, out += 5) {
    const dlkf_aided *a = &d->aids[s][boundary % DLKF_BOUNDARIES];
    memset(out, 0, 5 * sizeof *out);
    if (a->number != boundary) continue;
    const double n = a->count, variance = a->variance / n;
    out[0] = a->value / n;
    out[1] = isfinite(variance) ? sqrt(variance) : 0;
    out[2] = a->lag / n;
    out[3] = n > 1 ? (a->first - a->last) * n / (n - 1) : 0;
    out[4] = n;
  }
}

static dlkf_status file_aid(dlkf *d, int sensor, double t, double value, double std) {
  const double place = dlkf_samples_place(&d->samples, t);
  const dlkf_status timing = dlkf_samples_timing(&d->samples, place, FIRST_OF_AIDS);
  if (timing != DLKF_TAKEN) return dlkf_counted(d, timing);
  for (int k = 0; k < DLKF_STAMPS; k++)
    if (d->stamps[sensor][k] == t) return dlkf_counted(d, DLKF_DOUBLE);
  d->stamps[sensor][d->stamp[sensor]] = t;
  d->stamp[sensor] = (d->stamp[sensor] + 1) % DLKF_STAMPS;

  const int64_t row = (int64_t)place;
  dlkf_aided *a = &d->aids[sensor][row % DLKF_BOUNDARIES];
  const double after = dlkf_samples_boundary(&d->samples, row) - t, lag = after > 0 ? after : 0;
  if (a->number != row || (LAST[sensor] && t > a->newest)) {
    memset(a, 0, sizeof *a);
    a->number = row, a->newest = t, a->first = a->last = lag;
  } else if (LAST[sensor]) {
    return dlkf_counted(d, dlkf_replay(d, row) ? DLKF_REPLAYED : DLKF_TAKEN); /* an older one changes nothing */
  }
  a->count++;
  a->value += value;
  a->variance += std * std;
  a->lag += lag;
  if (lag > a->first) a->first = lag;
  if (lag < a->last) a->last = lag;
  return dlkf_counted(d, dlkf_replay(d, row) ? DLKF_REPLAYED : DLKF_TAKEN);
}

/* Those that came before the update intervals were laid. */
void dlkf_aids_file(dlkf *d) {
  for (int k = 0; k < d->early_aid_count; k++) {
    const dlkf_early_aid *x = &d->early_aids[(d->early_aid + k) % DLKF_EARLY_AIDS];
    if (dlkf_samples_place(&d->samples, x->t) >= FIRST_OF_AIDS) file_aid(d, x->sensor, x->t, x->value, x->std);
  }
  d->early_aid_count = 0;
}

dlkf_status dlkf_aid(dlkf *d, int sensor, double t, double value, double std) {
  d->made = d->given = 0;
  if (sensor < 0 || sensor >= DLKF_AIDS) return dlkf_counted(d, DLKF_NO_SENSOR);
  if (!isfinite(t) || !isfinite(value)) return dlkf_counted(d, DLKF_NOT_FINITE);
  if (fabs(value) > LARGEST_VALUE) return dlkf_counted(d, DLKF_IMPLAUSIBLE);
  if (std < 0) return dlkf_counted(d, DLKF_OUTSIDE);
  if (!isnan(d->samples.t0)) return file_aid(d, sensor, t, value, std);
  if (d->early_aid_count == DLKF_EARLY_AIDS) d->early_aid = (d->early_aid + 1) % DLKF_EARLY_AIDS, d->early_aid_count--;
  d->early_aids[(d->early_aid + d->early_aid_count++) % DLKF_EARLY_AIDS] = (dlkf_early_aid){sensor, t, value, std};
  return dlkf_counted(d, DLKF_TAKEN);
}

dlkf_status dlkf_speed(dlkf *d, double t, double speed, double std) { return dlkf_aid(d, dlkf_sensor("speed"), t, speed, std); }

dlkf_status dlkf_heading(dlkf *d, double t, double heading, double std) {
  return dlkf_aid(d, dlkf_sensor("heading"), t, heading, std);
}

dlkf_status dlkf_baro(dlkf *d, double t, double height_m, double std) { return dlkf_aid(d, dlkf_sensor("baro"), t, height_m, std); }
