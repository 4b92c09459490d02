/*
 * Commands of the host: each is answered, whether it is carried out or not.
 */
#ifndef AMB_DAQ_COMMANDS_H
#define AMB_DAQ_COMMANDS_H

#include <stdint.h>

#define ANSWER_LARGEST 24 /* bytes of code and fields */

/* Takes the body of a sound frame, n bytes; puts the answer at `answer`, which may be
 * the same place, and returns its length; 0: there is none, as it was no command. */
uint8_t commands_handle(const uint8_t *body, uint8_t n, uint8_t *answer);

/* Forgets the last command, as after a reset. */
void commands_begin(void);

#endif
