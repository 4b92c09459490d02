/*
 * The state of the controller, shared by all parts. Interrupts change what is volatile here, and read the rest: the
 * main loop writes it ATOMICALLY while ticks go on.
 */
#ifndef AMB_DAQ_DAQ_H
#define AMB_DAQ_DAQ_H

#include <stdint.h>

#include "board.h"
#include "control.h"
#include "excitation.h"
#include "protocol.h"
#include "trial.h"

#define FIRMWARE_MAJOR 1
#define FIRMWARE_MINOR 1

/* No command goes beyond these. A bench that must never see the full pulse width is compiled with less. */
#ifndef CAP_DUTY_LOW
#define CAP_DUTY_LOW 0
#endif
#ifndef CAP_DUTY_HIGH
#define CAP_DUTY_HIGH BOARD_PWM_TOP
#endif
#ifndef CAP_CURRENT_LOW
#define CAP_CURRENT_LOW 0
#endif
#ifndef CAP_CURRENT_HIGH
#define CAP_CURRENT_HIGH BOARD_ADC_TOP
#endif
/* Periods of a tick with which the output may be on: from 1 kHz, below which a fault would be seen too late, to 2.5 kHz,
 * at which a tick's work is done in time even while commands fill the line. */
#define CAP_OUTPUT_PERIOD 20
#define CAP_OUTPUT_FASTEST 8
#define HOST_MS_LEAST 20
#define HOST_MS_MOST 2000
#define LIFT_MS_MOST 2000
/* States that a law may have with ticks of so many periods: that many are done in time while noise fills the line. */
#define LAW_MOST(period) ((period) < 9 ? 3 : (period) < 10 ? 4 : LAW_STATES)
#define WATCH_MS 100 /* a law that begins with the output: else its filters would take the way to where the rotor lies for a step */
#define CONFIRM_MS_LEAST 20
#define CONFIRM_MS_MOST 20000
#define LIFTED_MS 100 /* inside its limits for so long: the rotor is lifted, the position counts from now on */

struct daq {
    volatile uint8_t state, cause;
    uint8_t ready;    /* bits READY_ */
    uint8_t sampling; /* ticks go on */
    uint16_t period;  /* of a tick, in periods of the pulse width */
    uint8_t stream;
    struct msg_limits limits;
    struct control control;
    struct excitation excitation;

    volatile uint32_t ticks; /* since start; the tick being worked on is the one before */
    volatile uint16_t silent_ticks, host_ticks;
    volatile uint16_t lift_ticks; /* left in which out_of_gap does not count */
    uint16_t watching; /* ticks left in which a law only watches, with the output still off */
    uint16_t inside; /* periods of the pulse width for which the position was inside its limits during the lift */
    uint16_t inputs[BOARD_ANALOG];

    uint32_t fault_tick;
    uint16_t fault_position, fault_current;
    volatile uint8_t fault_untold; /* the message is still to be sent */

    volatile uint16_t overruns, dropped, busy_us;
    uint16_t rx_errors, supply_mv, digest;
    struct trial trial;
    union {
        int8_t table[EXCITATION_TABLE];
        struct {
            int8_t table_before[EXCITATION_TABLE - LAW_TABLE];
            struct law coming; /* words of a law that comes; or that runs on trial */
        };
    };
};

extern struct daq daq;

static inline uint8_t daq_output_on(void)
{
    uint8_t state = daq.state;
    return state == STATE_DRIVING || state == STATE_LEVITATING;
}

/* One more of what is counted since reset; a full counter stays full. */
static inline void daq_count(volatile uint16_t *counter)
{
    ATOMICALLY
    {
        uint16_t value = *counter;
        if (value != 0xffff)
            *counter = (uint16_t)(value + 1);
    }
}

#endif
