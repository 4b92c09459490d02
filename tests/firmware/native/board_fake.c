/*
 * A board without hardware: what the firmware orders is kept to be asked for, what it reads is set by the test.
 */
#include "board_fake.h"

#include "board.h"

struct tx_ring board_tx;
struct rx_ring board_rx;
struct fake fake;

uint8_t board_begin(void) { return fake.by_watchdog; }
void board_output(uint8_t on) { fake.output = on; }
void board_await_order(void) {}
uint8_t board_order_waits(void) { return fake.order_waits; }
uint8_t board_order_late(void) { return fake.order_late; }
void board_await_input(uint8_t input) { (void)input; }

void board_duty(uint16_t duty)
{
    fake.duty = duty;
    if (duty > fake.highest_duty)
        fake.highest_duty = duty;
}
void board_lamp(uint8_t on) { (void)on; }
void board_ticks_start(uint16_t period, uint8_t inputs)
{
    fake.ticking = 1;
    fake.period = period;
    fake.inputs = inputs;
}
void board_ticks_stop(void) { fake.ticking = 0; }
uint8_t board_interlock_open(void) { return fake.interlock_open; }
uint8_t board_line_broken(void) { return fake.line_broken; }
uint16_t board_measure(uint8_t input) { return fake.analog[input]; }
uint16_t board_supply_mv(void) { return fake.supply_mv; }
uint16_t board_digest(void) { return fake.digest; }
uint16_t board_free_bytes(void) { return fake.free_bytes; }
uint8_t board_memory_sound(void) { return 1; }
uint8_t board_pwm_sound(void) { return !fake.pwm_broken; }
uint16_t board_rx_lost(void) { return 0; }
void board_send(void) {}
void board_receive(void) {}
uint16_t board_alive(void) { return 0; }
void board_sleep(uint8_t (*pending)(void)) { (void)pending; }
