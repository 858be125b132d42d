/* Lines of input to navigate, whatever stands in them: libFuzzer's entry round its main. Take -close_fd_mask=3. */
#define _GNU_SOURCE
#include <stdio.h>
#include <sys/mman.h>
#include <unistd.h>

#define main navigate
#include "navigate.c"
#undef main

int LLVMFuzzerTestOneInput(const unsigned char *bytes, size_t size) {
  const int file = memfd_create("lines", 0);
  if (file < 0 || write(file, bytes, size) != (ssize_t)size) return -1;
  lseek(file, 0, SEEK_SET);
  dup2(file, 0);
  close(file);
  clearerr(stdin);
  fseek(stdin, 0, SEEK_SET);
  char *arguments[] = {"navigate", "--samples", "--arm", "1", "0.3", "-1.2", NULL};
  navigate(6, arguments);
  return 0;
}
