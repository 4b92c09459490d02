/*
 * Changes of state other than faults (safety.h).
 */
#ifndef AMB_DAQ_STATES_H
#define AMB_DAQ_STATES_H

#include <stdint.h>

/* As after a reset. */
void daq_begin(uint8_t by_watchdog);
/* Ticks from 0. */
void daq_start(void);
/* Output on from the next tick on: STATE_DRIVING or STATE_LEVITATING. */
void daq_output(uint8_t state);
/* Output off, no ticks; a fault stays. */
void daq_stop(void);

#endif
