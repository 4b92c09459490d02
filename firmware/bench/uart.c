/* The serial port at the speed of the line: the emulator's own port counts eleven bits a byte and takes the speed when
 * UBRR0L is written; here it is put right after each write that has to do with it. */
#include <simavr/sim_io.h>
#include <stdio.h>
#include <string.h>

#include "controller.h"

enum { UCSR0A = 0xc0, UCSR0B = 0xc1, UCSR0C = 0xc2, UBRR0L = 0xc4, UBRR0H = 0xc5 };
enum { U2X = 1 << 1, RXEN = 1 << 4 };

static void see_speed(struct avr_irq_t *irq, uint32_t value, void *param)
{
    struct controller *c = param;
    const uint8_t *data = c->avr->data;
    const uint32_t divider = (data[UBRR0L] | (data[UBRR0H] & 0xfu) << 8) + 1;
    const uint32_t bit = divider * (data[UCSR0A] & U2X ? 8 : 16);
    const uint32_t parity = data[UCSR0C] >> 5 & 1, stops = 1 + (data[UCSR0C] >> 3 & 1);
    const uint32_t word = 5 + (data[UCSR0C] >> 1 & 3);
    (void)irq;
    (void)value;
    c->uart->cycles_per_byte = bit * (1 + word + parity + stops);
}

static void said(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    line_say(((struct controller *)param)->line, (uint8_t)value);
}

static void see_xoff(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    ((struct controller *)param)->xoff = value != 0;
}

static void see_xon(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)value;
    ((struct controller *)param)->xoff = 0;
}

static avr_irq_t *input(struct controller *c)
{
    return avr_io_getirq(c->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
}

/* One byte, each time that the line could have carried one. A receiver that is off or full is waited for. */
static avr_cycle_count_t feed(avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct controller *c = param;
    if (line_waiting(c->line) == 0) {
        c->feeding = 0;
        return 0;
    }
    if ((avr->data[UCSR0B] & RXEN) && !c->xoff) {
        /* Two bytes of buffer and one in the shift register: a real receiver holds no more. */
        const unsigned unread = (unsigned)(c->uart->input.write - c->uart->input.read) & 63u;
        c->late += unread > 3;
        const int byte = line_next(c->line);
        if (byte >= 0)
            avr_raise_irq(input(c), (uint32_t)byte);
    }
    return when + c->uart->cycles_per_byte;
}

void uart_feed(struct controller *c)
{
    if (c->feeding || line_waiting(c->line) == 0)
        return;
    c->feeding = 1;
    avr_cycle_timer_register(c->avr, 1, feed, c);
}

void controller_break(struct controller *c)
{
    if (c->avr->data[UCSR0B] & RXEN)
        avr_raise_irq(input(c), UART_INPUT_FE);
}

int uart_begin(struct controller *c)
{
    static const int watched[] = {UCSR0A, UCSR0C, UBRR0L, UBRR0H};
    uint32_t flags = 0; /* neither echo on standard output nor waiting in wall time */
    for (avr_io_t *io = c->avr->io_port; io != NULL; io = io->next)
        if (strcmp(io->kind, "uart") == 0 && ((avr_uart_t *)io)->name == '0')
            c->uart = (avr_uart_t *)io;
    if (c->uart == NULL) {
        fprintf(stderr, "amb_bench: this libsimavr's atmega328p has no serial port 0\n");
        return -1;
    }
    avr_ioctl(c->avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    for (size_t k = 0; k < sizeof watched / sizeof watched[0]; k++)
        avr_irq_register_notify(avr_iomem_getirq(c->avr, (avr_io_addr_t)watched[k], NULL, AVR_IOMEM_IRQ_ALL), see_speed,
                                c);
    avr_irq_register_notify(avr_io_getirq(c->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), said, c);
    avr_irq_register_notify(avr_io_getirq(c->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), see_xoff, c);
    avr_irq_register_notify(avr_io_getirq(c->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), see_xon, c);
    return 0;
}
