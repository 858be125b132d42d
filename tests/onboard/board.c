/* The core on a bare processor: a drive that stands in drive.h, rows by semihosting. */
#include <stdint.h>
#include <stdio.h>

#include "dlkf.h"
#include "drive.h"

static dlkf filter;
static const char *const SENSORS[] = {"speed", "heading", "baro"};

extern void _start(void);
void reset(void) {
  *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* the floating-point unit on */
  _start();
}
__attribute__((section(".vectors"), used)) static const uintptr_t VECTORS[] = {0x20400000, (uintptr_t)reset};

int main(void) {
  dlkf_open(&filter, ARM);
  for (unsigned k = 0; k < sizeof CALLS / sizeof *CALLS; k++) {
    const double *x = CALLS[k];
    if (x[0] > 0) dlkf_imu(&filter, x[1], x + 2, x + 5);
    else if (x[0] < 0) dlkf_aid(&filter, dlkf_sensor(SENSORS[(int)-x[0] - 1]), x[1], x[2], x[3]);
    else dlkf_gnss(&filter, x[1], x[2], x[3], x[4], x + 5, x + 8, (int)x[14]);
    for (const double *row; (row = dlkf_next(&filter));)
      printf("%.9f,%.12g,%.12g,%.12g,%.12g,%.12g\n", row[DLKF_T], row[DLKF_LAT_DEG], row[DLKF_LON_DEG], row[DLKF_HEIGHT_M], row[DLKF_VEL_N], row[DLKF_YAW]);
  }
  return 0;
}
