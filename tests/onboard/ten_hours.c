/* Ten hours in circles through an exported filter: what it allocates, and how much memory the process had then and now.
 *
 * malloc and its kin are this program's own, so that those of every library in the process are counted too. */
#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <sys/resource.h>

#include "step.h"

extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t), *__libc_memalign(size_t, size_t);
static long allocations;
void *malloc(size_t n) { allocations++; return __libc_malloc(n); }
void *calloc(size_t n, size_t m) { allocations++; return __libc_calloc(n, m); }
void *realloc(void *p, size_t n) { allocations++; return __libc_realloc(p, n); }
void *memalign(size_t a, size_t n) { allocations++; return __libc_memalign(a, n); }
void *aligned_alloc(size_t a, size_t n) { allocations++; return __libc_memalign(a, n); }
int posix_memalign(void **p, size_t a, size_t n) { allocations++; return !(*p = __libc_memalign(a, n)); }

enum { HOURS = 10 };
static const double SPEED = 10, RATE = 0.1, LAT = 0.85, LON = 0.15;
static double imu[DLKF_BEGIN_EPOCHS + 1][DLKF_SAMPLES * 6], fixes[DLKF_BEGIN_EPOCHS + 1][DLKF_FIX];
static double memory[2][DLKF_MEMORY], row[DLKF_ROW];

static void fix_at(double t, double *fix) {
  const double e2 = 6.69437999014e-3, w2 = 1 - e2 * sin(LAT) * sin(LAT), N = 6378137 / sqrt(w2), M = N * (1 - e2) / w2;
  const double yaw = RATE * t, north = SPEED / RATE * sin(yaw), east = SPEED / RATE * (1 - cos(yaw));
  const double known[] = {(LAT + north / (M + 100)) * 180 / M_PI, (LON + east / ((N + 100) * cos(LAT))) * 180 / M_PI, 100,
                          SPEED * cos(yaw), SPEED * sin(yaw), 0, 1, 1, 1, 0.1, 0.1, 0.1, 4, 0};
  for (int k = 0; k < DLKF_FIX; k++) fix[k] = k < 14 ? known[k] : NAN;
}

int main(void) {
  const double arm[3] = {0, 0, 0}, sample[6] = {0, SPEED * RATE, -9.81, 0, 0, RATE};
  for (int e = 0; e <= DLKF_BEGIN_EPOCHS; e++)
    for (int k = 0; k < DLKF_SAMPLES * 6; k++) imu[e][k] = sample[k % 6];
  const double epoch_s = DLKF_SAMPLES / (double)DLKF_RATE_HZ;
  long epoch = DLKF_BEGIN_EPOCHS;
  for (int k = 0; k <= epoch; k++) fix_at(k * epoch_s, fixes[k]);
  double ready = 0;
  dlkf_begin(imu[0], fixes[0], arm, memory[0], &ready);
  if (!(ready > 0)) return 3;
  struct rusage early, late;
  long counted = 0;
  for (long done = 0; done < HOURS * 3600 / epoch_s; done++) {
    if (done == 60) counted = allocations, getrusage(RUSAGE_SELF, &early);
    fix_at(++epoch * epoch_s, fixes[0]);
    dlkf_step(memory[done % 2], imu[0], fixes[0], memory[(done + 1) % 2], row);
  }
  getrusage(RUSAGE_SELF, &late);
  const double off = hypot((row[DLKF_LAT_DEG] - fixes[0][0]) * 111e3, (row[DLKF_LON_DEG] - fixes[0][1]) * 111e3 * cos(LAT));
  counted = allocations - counted;
  printf("%ld epochs, %ld allocations, %ld kB more, %.3f m off\n", epoch, counted, late.ru_maxrss - early.ru_maxrss, off);
  return 0;
}
