/* Isolated spikes of the IMU: single samples that an interface or a sensor has spoiled (dlkf.data.spikes). */
#include <math.h>
#include <string.h>

#include "constants.h"
#include "dlkf.h"

#if DLKF_STRETCH != SPIKE_BEFORE + 2 + DLKF_SPIKE_AHEAD
#error DLKF_STRETCH is not what a decision takes
#endif

static double limit(int axis) { return axis < 3 ? SPIKE_ACCEL : SPIKE_GYRO; }

static double larger(double a, double b) { return a > b ? a : b; }

/* Third quartile of the absolute differences of an axis before the sample that is judged. */
static double usual_difference(double x[][6], int axis) {
  double sorted[SPIKE_BEFORE];
  for (int n = 0; n < SPIKE_BEFORE; n++) {
    const double d = fabs(x[n + 1][axis] - x[n][axis]);
    int j = n;
    for (; j > 0 && sorted[j - 1] > d; j--) sorted[j] = sorted[j - 1];
    sorted[j] = d;
  }
  return sorted[SPIKE_QUARTILE];
}

/* Whether the third last sample of a stretch is a spike. */
static int spiked(double x[DLKF_STRETCH][6]) {
  const int k = SPIKE_BEFORE + 1;
  int some = 0;
  for (int sensor = 0; sensor < 2; sensor++) {
    int jumps = 0, steady = 1;
    for (int axis = 3 * sensor; axis < 3 * sensor + 3; axis++) {
      const double usual = usual_difference(x, axis), floor = limit(axis);
      const double up = x[k][axis] - x[k - 1][axis], down = x[k + 1][axis] - x[k][axis];
      const double least = fabs(up) < fabs(down) ? fabs(up) : fabs(down);
      const double before = fabs(x[k - 1][axis] - x[k - 2][axis]), after = fabs(x[k + 2][axis] - x[k + 1][axis]);
      const double beside = larger(fabs(up + down), larger(before, after));
      jumps |= least > larger(floor, SPIKE_RATIO * usual) && up * down < 0 && beside <= SPIKE_SHARE * least;
      steady &= larger(fabs(up), fabs(down)) <= larger(SPIKE_STEADY_FLOOR * floor, SPIKE_STEADY * usual);
    }
    if (!jumps && !steady) return 0;
    some |= jumps;
  }
  return some;
}

static const double *sample_before(const dlkf_spikes *s, int back) {
  return s->ring[(s->next + 2 * DLKF_STRETCH - 1 - back) % DLKF_STRETCH];
}

/* Whether the sample `back` before the last is a spike, where the missing ones after it are as steady as can be. */
static int would_be(const dlkf_spikes *s, int back) {
  double x[DLKF_STRETCH][6];
  const int missing = DLKF_SPIKE_AHEAD - back, known = DLKF_STRETCH - missing;
  if (s->count < known) return 0;
  for (int k = 0; k < DLKF_STRETCH; k++)
    memcpy(x[k], sample_before(s, k < known ? known - 1 - k : 1 - back), sizeof x[k]);
  return spiked(x);
}

/* Whether a sample is far from the last one in some axis, and that near the one before it. */
static int jumps(const dlkf_spikes *s, const double *x) {
  if (s->count < 2) return 0;
  const double *before = sample_before(s, 0), *earlier = sample_before(s, 1);
  for (int axis = 0; axis < 6; axis++) {
    const double far = fabs(x[axis] - before[axis]);
    if (far > limit(axis) && fabs(before[axis] - earlier[axis]) <= SPIKE_SHARE * far) return 1;
  }
  return 0;
}

/* Take a sample; 1 where the one two before it was a spike. */
int dlkf_spikes_add(dlkf_spikes *s, const double *x) {
  const int now = jumps(s, x), older = s->apart[0], old = s->apart[1];
  memcpy(s->ring[s->next], x, sizeof s->ring[0]);
  s->next = (s->next + 1) % DLKF_STRETCH;
  if (s->count < DLKF_STRETCH) s->count++;
  s->apart[0] = old;
  s->apart[1] = now;
  s->undecided = old && would_be(s, 1) ? 2 : now && would_be(s, 0) ? 1 : 0;
  return older && would_be(s, DLKF_SPIKE_AHEAD);
}
