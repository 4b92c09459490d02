/*
 * The safe state: output off, pulse width duty_off, latched until it is cleared. "The host requests, the controller
 * decides."
 */
#ifndef AMB_DAQ_SAFETY_H
#define AMB_DAQ_SAFETY_H

#include <stdint.h>

/* Enters the safe state, from anywhere. Does nothing in it: the first cause stays. */
void safety_enter(uint8_t cause);

/* What is wrong at this tick, by its inputs and by the host's silence; only while the output is on. */
uint8_t safety_check(void);

/* Whether the cause of the fault is gone: a code of messages.toml, CODE_DONE if so. */
uint8_t safety_clears(void);

#endif
