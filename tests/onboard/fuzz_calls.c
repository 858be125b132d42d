/* Calls of the core with whatever numbers: libFuzzer's entry, over a filter that waits, searches or runs.
 *
 * A filter is aligned once; every input begins from a copy of it, by its first byte of before there were fixes, of the
 * search for a heading, or of after it. Each call takes a byte for its kind and then, field by
 * field, one for a plausible value or for eight bytes of the input as they are. What holds whatever comes: statuses and
 * rows are in range, rows are finite in time and position, a copy of the memory goes on as the original does. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "dlkf.h"

enum { WAITING, SEARCHING, RUNNING, STAGES };
static dlkf stages[STAGES], filter, copy;
static double begin_t[STAGES];

static void sample(dlkf *d, double t) {
  const double yaw = 0.1 * t;
  dlkf_imu(d, t, (double[]){0, 0.3, -9.81}, (double[]){0, 0, 0.1});
  if (fabs(t - floor(t + 0.5)) < 0.005)
    dlkf_gnss(d, t, 50 + 2.7e-4 * sin(yaw), 8 + 4.2e-4 * (1 - cos(yaw)), 100, (double[]){3 * cos(yaw), 3 * sin(yaw), 0}, NULL, 4);
}

static void align(void) {
  int stage = WAITING;
  dlkf_open(&filter, (double[]){1, 0.3, -1.2});
  for (int k = 1; k < 5000 && stage < STAGES; k++) {
    sample(&filter, 0.02 * k);
    if (stage == WAITING ? k < 120 : dlkf_waits(&filter) != (stage == SEARCHING ? DLKF_WAITS_FOR_HEADING : DLKF_RUNS)) continue;
    memcpy(&stages[stage], &filter, sizeof filter);
    begin_t[stage++] = 0.02 * k;
  }
  if (stage < STAGES) abort();
}

typedef struct {
  const unsigned char *bytes;
  size_t left;
} input;

static unsigned byte(input *in) { return in->left ? in->left--, *in->bytes++ : 0; }

static double value(input *in, double usual) {
  const unsigned kind = byte(in);
  double x = 0;
  if (kind < 160) return usual;
  if (kind < 200) return usual + 0.01 * (kind - 180.0);
  if (kind < 240 && in->left >= sizeof x) {
    memcpy(&x, in->bytes, sizeof x);
    in->bytes += sizeof x, in->left -= sizeof x;
    return x;
  }
  static const double strange[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 5e-324, 0, -1, 1e9, 9.3e18, 90, 180, 2.5, 1e-300, -0.0, 400};
  return strange[kind % 16];
}

static void look(dlkf *d) {
  for (const double *row; (row = dlkf_next(d));)
    for (int c = DLKF_T; c <= DLKF_YAW; c++)
      if (!isfinite(row[c])) abort();
  if (d->made > DLKF_ROWS || d->samples.count > DLKF_RAW || d->samples.count < 0) abort();
  double pose[DLKF_COLUMNS];
  if (dlkf_pose(d, pose) == DLKF_RUNS && !isfinite(pose[DLKF_LAT_DEG] + pose[DLKF_LON_DEG])) abort();
}

int LLVMFuzzerTestOneInput(const unsigned char *bytes, size_t size) {
  if (begin_t[RUNNING] == 0) align();
  input in = {bytes, size};
  const unsigned stage = byte(&in) % STAGES;
  memcpy(&filter, &stages[stage], sizeof filter);
  double t = begin_t[stage];
  while (in.left) {
    const unsigned kind = byte(&in);
    int status = 0;
    if (kind < 128) {
      double x[7];
      for (int k = 0; k < 7; k++) x[k] = value(&in, k == 0 ? t + 0.02 : k == 3 ? -9.81 : k == 6 ? 0.1 : 0);
      status = (int)dlkf_imu(&filter, x[0], x + 1, x + 4);
      if (status == DLKF_TAKEN) t = x[0];
    } else if (kind < 200) {
      double x[13];
      for (int k = 0; k < 13; k++) x[k] = value(&in, k == 0 ? floor(t) : k == 1 ? 50 : k == 2 ? 8 : k == 3 ? 100 : k < 7 ? 5 : 1);
      status = (int)dlkf_gnss(&filter, x[0], x[1], x[2], x[3], kind & 1 ? x + 4 : NULL, kind & 2 ? x + 7 : NULL, (int)byte(&in) - 3);
    } else if (kind < 220) {
      for (unsigned k = byte(&in); k--;) sample(&filter, t += 0.02);
    } else if (kind < 230) {
      dlkf_finish(&filter);
    } else if (kind < 240) { /* put away and taken up again */
      memcpy(&copy, &filter, sizeof copy);
      memset(&filter, 0xA5, sizeof filter);
      memcpy(&filter, &copy, sizeof filter);
      if (!dlkf_fits(&filter)) abort();
    } else if (kind < 245) {
      dlkf_lay(&filter, value(&in, t), value(&in, 0.02));
    } else if (kind < 255) {
      const int sensor = (int)(byte(&in) % (DLKF_AIDS + 2)) - 1;
      const double at = value(&in, t), reading = value(&in, 3);
      status = (int)dlkf_aid(&filter, sensor, at, reading, value(&in, 0.1));
    }
    if (!(dlkf_doubt(&filter) >= 0 && dlkf_doubt(&filter) <= 1)) abort();
    if (status < 0 || status >= DLKF_STATUSES || !dlkf_says((dlkf_status)status)) abort();
    look(&filter);
  }
  return 0;
}
