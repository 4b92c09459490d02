/*
 * The controller looks at itself; idle only.
 */
#ifndef AMB_DAQ_SELFTEST_H
#define AMB_DAQ_SELFTEST_H

#include <stdint.h>

#include "protocol.h"

/* The failures with which nothing may be switched on: program, memory, pulse width. Bits FAILED_. */
uint16_t selftest_fatal(void);

/* Everything; all fields but the id are set. Some 20 ms. */
void selftest_run(struct msg_self_test_result *result);

#endif
