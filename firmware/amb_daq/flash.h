/*
 * Constants that stay in the program memory: RAM is short.
 */
#ifndef AMB_DAQ_FLASH_H
#define AMB_DAQ_FLASH_H

#ifdef __AVR__
#include <avr/pgmspace.h>
#define FLASH PROGMEM
#define flash_u8(p) pgm_read_byte(p)
#define flash_u16(p) pgm_read_word(p)
#define flash_copy(to, from, bytes) memcpy_P(to, from, bytes)
#else
#include <string.h>
#define FLASH
#define flash_u8(p) (*(p))
#define flash_u16(p) (*(p))
#define flash_copy(to, from, bytes) memcpy(to, from, bytes)
#endif

#endif
