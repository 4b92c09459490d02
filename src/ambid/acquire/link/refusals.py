"""What a controller's refusal means, in words: its code, and the field that it is about."""

from __future__ import annotations

from ambid.acquire.protocol.codec import Message
from ambid.acquire.protocol.table import table

_REMEDY = {
    "unknown": "Put the firmware of this ambid on the board",
    "length": "Put the firmware of this ambid on the board",
    "range": "Correct the rig",
    "state": "Stop it first, or clear its fault",
    "unready": "Give the rig a loop with gains, and open the device anew",
    "interlock": "Close the interlock loop (emergency stop, cable), then try again",
}


def refusal(asked: Message, answer: Message) -> str:
    """Return what was refused, why, and what to do.

    `asked`: the command; `answer`: its ``ack`` with a code that is not 0. Returns one line.
    """
    known = table()
    code = known.name("code", answer["code"])
    about = next((e.about for e in known.enums["code"] if e.value == answer["code"]), "an unknown code")
    return (
        f"the controller refuses {asked.name!r}: {_why(asked, code, answer['detail'], about)}."
        f" {_REMEDY.get(code, 'Put the firmware of this ambid on the board')}"
    )


def _why(asked: Message, code: str, detail: int, about: str) -> str:
    known = table()
    if code == "range" and asked.name == "start":
        return (
            f"mode {known.name('mode', asked['mode'])!r} does not go with what it was told: with the output on, a tick"
            " is neither very short nor very long (daq.rate_hz), and set point and bias are within the limits"
        )
    if code == "range":
        fields = known.messages[asked.name].fields
        if 1 <= detail <= len(fields):
            field = fields[detail - 1]
            value = asked.fields.get(field.name, asked.values)
            return f"{field.name} = {value} is outside what it allows ({field.about})"
        return f"a value is outside what it allows (field {detail})"
    if code == "state":
        return f"not in state {known.name('state', detail)}"
    if code == "unready":
        there = known.names_of_bits("ready", detail)
        missing = [e.name for e in known.bits["ready"] if e.name not in there]
        return f"it has not been given {', '.join(missing)} yet"
    return about
