/*
 * Setup and main loop: what interrupts leave behind is sent, at most one command is carried out, then sleep.
 */
#include "app.h"

#include <string.h>

#include "commands.h"
#include "daq.h"
#include "frame.h"
#include "report.h"
#include "states.h"

#define BYTES_A_PASS 8 /* some 0.2 ms with ticks and bytes coming: samples go first, and the watchdog is fed */

static struct decoder decoder;

void amb_setup(void)
{
    uint8_t by_watchdog = board_begin();
    memset(&decoder, 0, sizeof decoder);
    commands_begin();
    daq_begin(by_watchdog);
}

/* Takes bytes until one command is done, or so many of whatever else comes; the answer takes the command's place. While an
 * answer finds no room, bytes wait. */
static void listen(void)
{
    uint8_t n = 0, most = BYTES_A_PASS;
    if (tx_free(&board_tx) < FRAME_BYTES(ANSWER_LARGEST))
        return;
    while (n == 0 && most-- && rx_waiting(&board_rx)) {
        n = decoder_feed(&decoder, rx_take(&board_rx));
        board_receive();
        if (n == FRAME_DAMAGED) {
            daq_count(&daq.rx_errors);
            n = 0;
        }
    }
    if (n == 0)
        return;
    n = commands_handle(decoder.body, n, decoder.body);
    if (n == 0)
        return;
    frame_put(&board_tx, decoder.body, n, 0);
    board_send();
}

static uint8_t pending(void)
{
    return report_waits() || (rx_waiting(&board_rx) && tx_free(&board_tx) >= FRAME_BYTES(ANSWER_LARGEST));
}

/* On while levitating; after a fault it blinks, some two times a second. */
static void show(uint16_t beats)
{
    uint8_t state = daq.state;
    board_lamp(state == STATE_LEVITATING || (state == STATE_FAULT && (beats & 0x200)));
}

void amb_loop(void)
{
    show(board_alive());
    board_rx_lost();
    report_pending();
    listen();
    board_sleep(pending);
}
