/* What the controller's registers do to the bench, and the bench to its pins. The plant is carried lazily: up to the
 * tick of each write that changes the output, and of each conversion. */
#include "controller.h"

#include <math.h>
#include <simavr/avr_adc.h>
#include <simavr/avr_ioport.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_io.h>
#include <stdlib.h>
#include <string.h>

#include "journal.h"

#define CLOCK_HZ 16000000u
#define SUPPLY_MV 5000u
#define SLICE 400 /* ticks of the longest run between two looks at the bench; also the mark by which a reset is seen */

/* Addresses in data space. */
enum { DDRB = 0x24, PORTB = 0x25, ADCSRA = 0x7a, ADMUX = 0x7c };
enum { TCCR1A = 0x80, TCCR1B = 0x81, TCNT1L = 0x84, ICR1L = 0x86, OCR1AL = 0x88 };
enum { ADEN = 1 << 7, ADSC = 1 << 6, ADATE = 1 << 5, ADIF = 1 << 4 };
enum { ENABLE = 1 << 0, PULSE = 1 << 1, LAMP = 1 << 5 };

double controller_seconds(const struct controller *c) { return (double)c->avr->cycle / CLOCK_HZ; }

/* ---- the plant ------------------------------------------------------------------------------------------------- */

static void see_touch(struct controller *c)
{
    const struct plant *p = c->plant;
    const double margin = 0.02 * (p->is.stop[1] - p->is.stop[0]);
    if (p->touching && c->away)
        journal_write((double)c->at / CLOCK_HZ, "stop", "\"side\": \"%s\", \"position\": %.9g",
                      p->touching > 0 ? "high" : "low", p->x);
    if (p->touching)
        c->away = 0;
    else if (p->x > p->is.stop[0] + margin && p->x < p->is.stop[1] - margin)
        c->away = 1;
}

void controller_carry(struct controller *c)
{
    const struct plant_config *is = &c->plant->is;
    while (c->at < c->avr->cycle) {
        uint64_t until;
        int bottom;
        const int level = pwm_level(&c->pwm, c->at, &until, &bottom);
        const double part = is->averaged ? (double)pwm_width(&c->pwm) / pwm_period(&c->pwm) : level;
        const int cut_short = until > c->avr->cycle;
        const unsigned ticks = (unsigned)((cut_short ? c->avr->cycle : until) - c->at);
        const double volts = is->low + part * (is->high - is->low);
        c->volt_ticks += ticks * plant_advance(c->plant, ticks, c->enabled ? PLANT_DRIVEN : PLANT_OFF, volts);
        c->at += ticks;
        see_touch(c);
        if (bottom && !cut_short) {
            c->pwm.compare = c->pwm.next;
            plant_draw(c->plant, pwm_period(&c->pwm));
        }
    }
}

/* ---- outputs --------------------------------------------------------------------------------------------------- */

static uint32_t word_at(const avr_t *avr, int low) { return avr->data[low] | (uint32_t)avr->data[low + 1] << 8; }

static void see_port(struct controller *c)
{
    const uint8_t driven = c->avr->data[DDRB] & c->avr->data[PORTB];
    const int enabled = (driven & ENABLE) != 0;
    c->pwm.output = (c->avr->data[DDRB] & PULSE) != 0;
    c->pwm.level = (driven & PULSE) != 0;
    c->lamp = (driven & LAMP) != 0;
    if (enabled == c->enabled)
        return;
    c->enabled = enabled;
    if (enabled && c->first_enable == UINT64_MAX)
        c->first_enable = c->avr->cycle;
    journal_write(controller_seconds(c), "enable", "\"level\": %d, \"duty\": %u, \"position\": %.9g, \"current\": %.9g",
                  enabled, pwm_width(&c->pwm), c->plant->x, c->plant->i);
}

/* Only in the modes that count up to it can ICR1 be written; elsewhere it keeps what it had. */
static void see_top(struct controller *c, int mode)
{
    uint8_t *data = c->avr->data;
    if (mode == 8 || mode == 10 || mode == 12 || mode == 14) {
        c->top = (uint16_t)word_at(c->avr, ICR1L);
        return;
    }
    if (word_at(c->avr, ICR1L) != c->top)
        journal_write(controller_seconds(c), "ignored", "\"what\": \"ICR1 in mode %d of Timer1\"", mode);
    data[ICR1L] = (uint8_t)c->top;
    data[ICR1L + 1] = (uint8_t)(c->top >> 8);
}

static void see_timer(struct controller *c, int address)
{
    const uint8_t *data = c->avr->data;
    const int clock = data[TCCR1B] & 7;
    const int mode = (data[TCCR1A] & 3) | (data[TCCR1B] >> 1 & 0xc);
    if (address == ICR1L)
        see_top(c, mode);
    const int running = clock == 1 && mode == 14;
    if (clock != 0 && mode == 14 && clock != 1 && !c->odd_mode)
        journal_write(controller_seconds(c), "unsupported", "\"what\": \"a prescaler of Timer1\"");
    if (clock != 0 && mode != 14 && data[TCCR1A] >> 6 && !c->odd_mode)
        journal_write(controller_seconds(c), "unsupported", "\"what\": \"mode %d of Timer1\"", mode);
    c->odd_mode |= clock != 0 && (mode != 14 || clock != 1);
    if ((running && !c->pwm.running) || (running && address == TCNT1L))
        c->pwm.base = c->avr->cycle - (address == TCNT1L ? word_at(c->avr, TCNT1L) % (c->pwm.top + 1) : 0);
    c->pwm.running = running;
    c->pwm.connected = data[TCCR1A] >> 6;
    c->pwm.top = word_at(c->avr, ICR1L);
    if (address == OCR1AL || address == 0)
        c->pwm.next = word_at(c->avr, OCR1AL);
    if (!running)
        c->pwm.compare = c->pwm.next;
}

static void written(struct avr_irq_t *irq, uint32_t value, void *param)
{
    struct controller *c = param;
    static const int address_of[] = {DDRB, PORTB, TCCR1A, TCCR1B, TCNT1L, ICR1L, OCR1AL};
    (void)value;
    controller_carry(c);
    for (size_t k = 0; k < sizeof address_of / sizeof address_of[0]; k++) {
        if (irq != avr_iomem_getirq(c->avr, (avr_io_addr_t)address_of[k], NULL, AVR_IOMEM_IRQ_ALL))
            continue;
        if (address_of[k] == DDRB || address_of[k] == PORTB)
            see_port(c);
        else
            see_timer(c, address_of[k]);
    }
}

/* ---- inputs ---------------------------------------------------------------------------------------------------- */

/* The emulator's converter gives floor(mV 1023 / reference); here it is given the least mV that yields the count of an
 * ideal converter, floor(V 1024 / reference). */
static uint32_t millivolts_for(double volts, uint32_t reference)
{
    double count = floor(volts * 1000.0 / reference * 1024.0);
    count = count < 0.0 ? 0.0 : count > 1023.0 ? 1023.0 : count;
    return ((uint32_t)count * reference + 1022) / 1023;
}

/* The input is held one and a half clocks of the converter after the conversion has begun (data sheet). */
static avr_cycle_count_t hold_cycles(const struct controller *c)
{
    const unsigned prescaler = c->avr->data[ADCSRA] & 7u;
    return ((avr_cycle_count_t)3 << (prescaler ? prescaler : 1u)) / 2;
}

static void write_row(const struct controller *c)
{
    const uint64_t ticks = c->at - c->volt_from, begin = c->at - (c->at - c->pwm.base) % pwm_period(&c->pwm);
    if (c->trajectory == NULL)
        return;
    fprintf(c->trajectory, "%.8f,%.12g,%.12g,%.12g,%.9g,%u,", controller_seconds(c), c->plant->x, c->plant->v,
            c->plant->i, ticks ? c->volt_ticks / (double)ticks : 0.0, c->enabled ? pwm_width(&c->pwm) : 0);
    fprintf(c->trajectory, "%.8f,%.8f,%.8f\n", (double)begin / CLOCK_HZ, (double)c->current_held[0] / CLOCK_HZ,
            (double)c->current_held[1] / CLOCK_HZ);
}

static avr_cycle_count_t held(struct avr_t *avr, avr_cycle_count_t when, void *param)
{
    struct controller *c = param;
    avr_irq_t *inputs = avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0);
    const unsigned source = c->converted;
    (void)when;
    controller_carry(c);
    double volts = 0.0;
    if (source < PLANT_SENSORS) {
        volts = plant_pin(c->plant, (enum plant_sensor)source);
        if (!isnan(c->override[source]))
            volts = c->override[source];
    }
    if (source == PLANT_CURRENT) {
        c->current_held[0] = c->current_held[1];
        c->current_held[1] = c->at;
    }
    if (source == PLANT_POSITION) {
        write_row(c);
        c->volt_ticks = 0.0;
        c->volt_from = c->at;
        c->conversions++;
    }
    const uint32_t reference = c->avr->data[ADMUX] >> 6 == 3 ? 1100 : SUPPLY_MV;
    /* At every input: the emulator looks at the multiplexer again when the result is read. */
    for (int channel = 0; channel < 8; channel++)
        avr_raise_irq(inputs + channel, millivolts_for(volts, reference));
    return 0;
}

static void converting(struct avr_irq_t *irq, uint32_t value, void *param)
{
    struct controller *c = param;
    union {
        uint32_t value;
        avr_adc_mux_t mux;
    } of = {.value = value};
    (void)irq;
    if (of.mux.kind != ADC_MUX_SINGLE)
        return;
    c->converted = of.mux.src;
    avr_cycle_timer_register(c->avr, hold_cycles(c), held, c);
}

static void wire_pin(struct controller *c, int pin, int level)
{
    avr_irq_t *irq = avr_io_getirq(c->avr, AVR_IOCTL_IOPORT_GETIRQ('D'), pin);
    avr_raise_irq(irq, (uint32_t)!level); /* raised only where it changes: after a reset the register has forgotten */
    avr_raise_irq(irq, (uint32_t)level);
}

void controller_wire(struct controller *c)
{
    const int receive = c->line->cable != CABLE_CUT_LOW;
    avr_ioport_external_t outside = {.name = 'D', .mask = 1 << 0 | 1 << 7};
    outside.value = (unsigned long)(receive | c->interlock_open << 7) & 0xffu;
    avr_ioctl(c->avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('D'), &outside);
    wire_pin(c, IOPORT_IRQ_PIN0, receive);
    wire_pin(c, IOPORT_IRQ_PIN7, c->interlock_open);
}

/* ---- running --------------------------------------------------------------------------------------------------- */

static struct controller *asleep; /* the emulator hands its sleep no more than itself; there is one in a process */

/* Called over and over while it sleeps, and never in real time. Once, at its beginning: a converter that is on, idle and
 * without trigger of its own starts a conversion when the processor stops. */
static void sleep_without_waiting(avr_t *avr, avr_cycle_count_t how_long)
{
    const uint8_t control = avr->data[ADCSRA];
    const avr_io_addr_t at = AVR_DATA_TO_IO(ADCSRA);
    (void)how_long;
    if (!asleep->awake)
        return;
    asleep->awake = 0;
    if ((control & (ADEN | ADSC | ADATE)) == ADEN && avr->io[at].w.c != NULL)
        avr->io[at].w.c(avr, ADCSRA, (uint8_t)((control & ~ADIF) | ADSC), avr->io[at].w.param);
}

static void log_errors_only(avr_t *avr, const int level, const char *format, va_list values)
{
    (void)avr;
    if (level == LOG_ERROR)
        vfprintf(stderr, format, values);
}

/* A reset forgets the registers without writing them, and all timers. */
static void see_reset(struct controller *c)
{
    if (c->avr->run_cycle_limit == SLICE)
        return;
    c->avr->run_cycle_limit = SLICE;
    c->feeding = 0;
    c->xoff = 0;
    c->top = 0;
    controller_carry(c);
    see_timer(c, 0);
    see_port(c);
    controller_wire(c);
    c->resets++;
    journal_write(controller_seconds(c), "reset", NULL);
}

int controller_begin(struct controller *c, const char *firmware, struct plant *plant, struct line *line)
{
    static const int watched[] = {DDRB, PORTB, TCCR1A, TCCR1B, TCNT1L, ICR1L, OCR1AL};
    elf_firmware_t elf;
    memset(c, 0, sizeof *c);
    memset(&elf, 0, sizeof elf);
    c->plant = plant;
    c->line = line;
    c->first_enable = UINT64_MAX;
    for (int k = 0; k < PLANT_SENSORS; k++)
        c->override[k] = NAN;
    avr_global_logger_set(log_errors_only);
    if (elf_read_firmware(firmware, &elf) != 0 || elf.flashsize == 0) {
        fprintf(stderr, "amb_bench: --firmware %s: not an ELF file for the controller\n", firmware);
        return -1;
    }
    c->avr = avr_make_mcu_by_name("atmega328p");
    if (c->avr == NULL) {
        fprintf(stderr, "amb_bench: this libsimavr does not know the atmega328p\n");
        return -1;
    }
    avr_init(c->avr);
    avr_load_firmware(c->avr, &elf);
    c->avr->frequency = CLOCK_HZ;
    c->avr->vcc = c->avr->avcc = c->avr->aref = SUPPLY_MV;
    c->avr->log = LOG_ERROR;
    c->avr->sleep = sleep_without_waiting;
    asleep = c;
    c->avr->run_cycle_limit = SLICE;
    for (size_t k = 0; k < sizeof watched / sizeof watched[0]; k++)
        avr_irq_register_notify(avr_iomem_getirq(c->avr, (avr_io_addr_t)watched[k], NULL, AVR_IOMEM_IRQ_ALL), written, c);
    avr_irq_register_notify(avr_io_getirq(c->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER), converting, c);
    controller_wire(c);
    plant_draw(plant, pwm_period(&c->pwm));
    return uart_begin(c);
}

int controller_run(struct controller *c)
{
    c->awake = c->avr->state != cpu_Sleeping;
    const int state = avr_run(c->avr);
    see_reset(c);
    return state;
}
