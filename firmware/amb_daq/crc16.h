/*
 * CRC-16/XMODEM: polynomial 0x1021, start 0, not reflected.
 */
#ifndef AMB_DAQ_CRC16_H
#define AMB_DAQ_CRC16_H

#include <stdint.h>

#ifdef __AVR__
#include <util/crc16.h>
#define crc16_add _crc_xmodem_update
#else
static inline uint16_t crc16_add(uint16_t crc, uint8_t byte)
{
    uint8_t i;
    crc = (uint16_t)(crc ^ ((uint16_t)byte << 8));
    for (i = 0; i < 8; i++)
        crc = (uint16_t)((crc << 1) ^ ((crc & 0x8000u) ? 0x1021 : 0));
    return crc;
}
#endif

#endif
