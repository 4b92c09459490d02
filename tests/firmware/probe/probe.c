/* A small firmware that tests the emulated bench itself: pulse width, converter, serial line, pins, watchdog.
 *
 * It answers single letters on the serial line at 1 Mbaud:
 *   a        three conversions of the last tick, 16 bits each, low byte first
 *   b LO HI  compare value of the pulse width; answers 'b'
 *   c V      connection of the output pin (COM1A) and its port bit: V = COM1A | level << 2; answers 'c'
 *   d        port D as read
 *   e V      ENABLE; answers 'e'
 *   f        frames without stop bit so far
 *   g N      answers with N bytes 0, 1, 2, ...
 *   h        hangs, until the watchdog resets; the next boot says 'w', any other boot says 'B'
 *   i M LO   ICR1 = LO written in mode M of Timer1 (0 to 15), which stands still meanwhile; answers with ICR1, low byte first
 *   l        bits of port D that were high at every tick since the last 'l'
 *   s V      stream: V = 1 sends tick (16 bits) and two conversions at every tick, V = 0 ends it; answers nothing
 *   t        ticks so far, 32 bits
 *   z V      sleeps once, with the converter on (V = 1) or off and nothing asked of it; answers whether it converted
 *   x V      answers with V
 * Anything else is answered with '?'. */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#define CONVERT (_BV(ADEN) | _BV(ADSC) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS0)) /* 500 kHz */

static volatile uint16_t result[3];
static volatile uint8_t channel, wrong_frames, streaming, quiet, always_high = 0xff;
static volatile uint32_t ticks;

static volatile uint8_t in[64], in_last, out[256], out_last;
static uint8_t in_first;
static volatile uint8_t out_first;
static uint8_t mcusr __attribute__((section(".noinit")));

void first_of_all(void) __attribute__((naked, used, section(".init3")));
void first_of_all(void)
{
    mcusr = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

static void say(uint8_t byte)
{
    while ((uint8_t)(out_last + 1) == out_first)
        ;
    out[out_last] = byte;
    out_last++;
    UCSR0B |= _BV(UDRIE0);
}

ISR(USART_UDRE_vect)
{
    if (out_first == out_last) {
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
        return;
    }
    UDR0 = out[out_first];
    out_first++;
}

ISR(USART_RX_vect)
{
    if (UCSR0A & _BV(FE0))
        wrong_frames++;
    in[in_last] = UDR0;
    in_last = (in_last + 1) & 63;
}

ISR(TIMER2_COMPA_vect)
{
    ticks++;
    always_high &= PIND;
    if (quiet)
        return;
    channel = 0;
    ADMUX = _BV(REFS0);
    ADCSRA = CONVERT;
}

ISR(ADC_vect)
{
    result[channel] = ADC;
    if (++channel < 3) {
        ADMUX = _BV(REFS0) | channel;
        ADCSRA = CONVERT;
        return;
    }
    ADCSRA = 0; /* or falling asleep would start one more */
    if (streaming && (uint8_t)(out_first - out_last - 1) >= 8) {
        say((uint8_t)ticks);
        say((uint8_t)(ticks >> 8));
        say((uint8_t)result[0]);
        say((uint8_t)(result[0] >> 8));
        say((uint8_t)result[1]);
        say((uint8_t)(result[1] >> 8));
    }
}

static uint8_t next(void)
{
    while (in_first == in_last)
        sleep_mode();
    const uint8_t byte = in[in_first];
    in_first = (in_first + 1) & 63;
    return byte;
}

static void answer(uint8_t letter)
{
    uint8_t v;
    switch (letter) {
    case 'a':
        for (v = 0; v < 3; v++) {
            cli();
            const uint16_t count = result[v];
            sei();
            say((uint8_t)count);
            say((uint8_t)(count >> 8));
        }
        return;
    case 'b':
        v = next();
        OCR1A = (uint16_t)(v | next() << 8);
        break;
    case 'c':
        v = next();
        PORTB = (PORTB & (uint8_t)~_BV(PB1)) | (v & 4 ? _BV(PB1) : 0);
        TCCR1A = (uint8_t)((v & 3) << 6 | _BV(WGM11));
        break;
    case 'd':
        say(PIND);
        return;
    case 'e':
        if (next())
            PORTB |= _BV(PB0);
        else
            PORTB &= (uint8_t)~_BV(PB0);
        break;
    case 'f':
        say(wrong_frames);
        return;
    case 'g':
        v = next();
        for (uint8_t k = 0; k < v; k++)
            say(k);
        return;
    case 'h':
        wdt_enable(WDTO_15MS);
        for (;;)
            ;
    case 'i':
        v = next();
        TCCR1B = 0;
        TCCR1A = v & 3;
        TCCR1B = (uint8_t)((v & 0xc) << 1);
        ICR1 = next();
        say(ICR1L);
        say(ICR1H);
        return;
    case 'l':
        say(always_high);
        always_high = 0xff;
        return;
    case 's':
        streaming = next();
        return;
    case 't':
        for (v = 0; v < 32; v += 8)
            say((uint8_t)(ticks >> v));
        return;
    case 'z':
        v = next();
        quiet = 1;
        while (ADCSRA & _BV(ADSC))
            ;
        ADCSRA = _BV(ADEN) | _BV(ADIF);
        ADCSRA = (uint8_t)(v ? _BV(ADEN) | _BV(ADPS2) | _BV(ADPS0) : 0);
        sleep_mode();
        __builtin_avr_delay_cycles(1000);
        say((ADCSRA & _BV(ADIF)) != 0);
        quiet = 0;
        return;
    case 'x':
        say(next());
        return;
    default:
        letter = '?';
    }
    say(letter);
}

int main(void)
{
    PORTD = _BV(PD7);
    DDRB = _BV(PB0) | _BV(PB1) | _BV(PB5);
    TCCR1A = _BV(COM1A1) | _BV(WGM11);
    TCCR1B = _BV(WGM13) | _BV(WGM12);
    ICR1 = 799;
    OCR1A = 399;
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);
    OCR2A = 249;
    TCCR2A = _BV(WGM21);
    TCCR2B = _BV(CS21) | _BV(CS20); /* 32 */
    TIMSK2 = _BV(OCIE2A);
    UCSR0A = _BV(U2X0);
    UBRR0 = 1;
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
    say(mcusr & _BV(WDRF) ? 'w' : 'B');
    for (;;)
        answer(next());
}
