"""The alarms of a machine: all of them, what has happened, and what people do about them."""

from __future__ import annotations

import asyncio
import re
import secrets
from collections import OrderedDict
from typing import TYPE_CHECKING, Any

from starlette.responses import PlainTextResponse, RedirectResponse

from daqsvc.alarms.commands import AlarmCommand, CommandOutcome, Verb
from daqsvc.errors.code import with_code
from daqsvc.page.access.person import peer_of
from daqsvc.page.access.role import Role
from daqsvc.page.guard import FormError
from daqsvc.page.text import alarm_list, event_rows
from daqsvc.settings.alarms import AlarmHandling

if TYPE_CHECKING:
    from collections.abc import Mapping

    from starlette.requests import Request
    from starlette.responses import Response

    from daqsvc.page.access.person import Person
    from daqsvc.page.guard import Forms
    from daqsvc.page.machine_live import MachineLive
    from daqsvc.page.sources import MachineSource

    Document = dict[str, Any]

MOST_EVENTS = 200
"""Of the journal that are shown."""
MOST_OUTCOMES = 200
NOT_AN_OPERATOR = "the page lets operators handle alarms, and this person is a viewer"
TIMES = {"1": "1 hour", "4": "4 hours", "8": "8 hours", "24": "1 day"}
"""How long an alarm may be shelved for by the page, h."""
OFFERS: Mapping[Verb, tuple[str, str]] = {
    Verb.ACKNOWLEDGE: ("Acknowledge", "You have seen it."),
    Verb.RESET: ("Reset", "Reset a latched alarm whose condition is no longer present."),
    Verb.SHELVE: ("Shelve", "Suppress it for a time; it returns by itself."),
    Verb.UNSHELVE: ("Unshelve", "Uncover it now."),
    Verb.BYPASS: ("Bypass", "Take it out of service until somebody puts it back."),
    Verb.UNBYPASS: ("Put back into service", "End the bypass."),
}
DONE = {
    Verb.ACKNOWLEDGE: "acknowledged",
    Verb.RESET: "reset",
    Verb.SHELVE: "shelved",
    Verb.UNSHELVE: "unshelved",
    Verb.BYPASS: "bypassed",
    Verb.UNBYPASS: "put back into service",
}
HOW_TO_ACT = "On this box, daqsvc page --operator-link prints an address for operators."
_ONE_LINE = re.compile(r"\s+")


def offered(alarm: Document | None) -> list[Verb]:
    """What can be done with an alarm as it stands.

    Args:
        alarm: its last event; None for one that never had one.
    """
    if alarm is None:
        return [Verb.SHELVE, Verb.BYPASS]
    state = str(alarm["state"])
    own = str(alarm.get("covered") or state)
    holds = {state, *alarm.get("holds", ())}
    verbs = []
    if own.endswith("_unacknowledged"):
        verbs.append(Verb.ACKNOWLEDGE)
    if own.startswith("latched"):
        verbs.append(Verb.RESET)
    verbs.append(Verb.UNSHELVE if "shelved" in holds else Verb.SHELVE)
    verbs.append(Verb.UNBYPASS if "out_of_service" in holds else Verb.BYPASS)
    return verbs


class FormOutcomes:
    """What came of forms, for the page that follows; each is known by a secret, and kept for a while."""

    def __init__(self) -> None:
        self._outcomes: OrderedDict[str, tuple[str, bool]] = OrderedDict()

    def keep(self, text: str, *, is_good: bool) -> str:
        """Keep what came of one; the secret."""
        secret = secrets.token_urlsafe(12)
        self._outcomes[secret] = text, is_good
        while len(self._outcomes) > MOST_OUTCOMES:
            self._outcomes.popitem(last=False)
        return secret

    def of(self, secret: str) -> tuple[str, bool]:
        """What came of it, and whether that is good; empty if that is not known."""
        return self._outcomes.get(secret, ("", True))


async def alarms_page(
    source: MachineSource,
    live: MachineLive,
    machine: str,
    request: Request,
    forms: Forms,
    outcomes: FormOutcomes,
) -> Document:
    """What the template ``alarms.html`` needs.

    Args:
        source: of the machines.
        live: the machine.
        machine: its name in addresses.
        request: what was asked.
        forms: makes tokens.
        outcomes: what came of forms.
    """
    asked = request.query_params.get("alarm", "")
    person: Person = request.state.person
    known = live.all_alarms()
    chosen = asked if asked in known else ""
    text, is_good = outcomes.of(request.query_params.get("outcome", ""))
    try:
        events, why = await source.journal(machine, chosen, MOST_EVENTS), ""
    except OSError:
        events, why = [], "the journal cannot be read by who runs the page"
    alarm = known.get(chosen)
    if chosen and events and (alarm is None or events[0]["wall_ns"] >= alarm["wall_ns"]):
        alarm = events[0]  # the last command may not be shown yet
    return {
        "rows": alarm_list(known, machine),
        "asked": asked,
        "chosen": chosen,
        "state": alarm_list({chosen: alarm}, machine) if chosen else "",
        "occurrence": "" if alarm is None else alarm["occurrence"] or "",
        "offers": [(verb, *OFFERS[verb]) for verb in (offered(alarm) if chosen else ())],
        "times": _times(live),
        "events": event_rows(events),
        "why": why,
        "token": forms.token(person),
        "may_act": person.role is Role.OPERATOR,
        "how_to_act": "" if person.session else HOW_TO_ACT,
        "outcome": text,
        "is_good": is_good,
    }


async def handle(
    source: MachineSource, machine: str, request: Request, forms: Forms, outcomes: FormOutcomes
) -> Response:
    """Do with an alarm what a form asks for, and show what came of it."""
    person: Person = request.state.person
    try:
        fields = await forms.read(request)
    except FormError as error:
        return PlainTextResponse(f"Nothing was done: {error}.", 403)
    try:
        command = _command(fields, machine, person)
    except FormError as error:
        alarm = fields.get("alarm", "")
        return _shown(request, machine, alarm, outcomes.keep(f"Nothing was done: {error}.", is_good=False))
    denied = "" if person.role is Role.OPERATOR else NOT_AN_OPERATOR
    via = f"page {peer_of(request)} {person.name}"
    handling = asyncio.ensure_future(source.handle(machine, command, denied, via))
    # A browser that goes away takes nothing back.
    outcome: CommandOutcome = await asyncio.shield(handling)
    if outcome.accepted:
        then = f"; {with_code(outcome.reason, outcome.code)}" if outcome.reason else ""
        text = f"{command.alarm} is {DONE[command.verb]} by {person.name}{then}."
    else:
        text = f"Nothing was done: {with_code(outcome.reason, outcome.code)}."
    return _shown(request, machine, command.alarm, outcomes.keep(text, is_good=outcome.accepted))


def _times(live: MachineLive) -> Document:
    """How long an alarm may be shelved for, as far as the machine file lets people do so."""
    default_s = AlarmHandling.model_fields["shelve_at_most_s"].default
    most_s = live.values.get("alarm_handling", {}).get("shelve_at_most_s", default_s)
    times = {hours: label for hours, label in TIMES.items() if float(hours) * 3600.0 <= most_s}
    return times or dict([next(iter(TIMES.items()))])


def _command(fields: Mapping[str, str], machine: str, person: Person) -> AlarmCommand:
    """The command that a form asks for.

    Raises:
        FormError: it is none.
    """
    if fields.get("verb") not in {*Verb} or not fields.get("alarm"):
        raise FormError("it does not state the command and the alarm")
    verb = Verb(fields["verb"])
    hours = fields.get("hours", "")
    if verb is Verb.SHELVE and hours not in TIMES:
        raise FormError("it does not state for how long")
    reason = _ONE_LINE.sub(" ", fields.get("reason", "")).strip()
    if verb in {Verb.SHELVE, Verb.BYPASS} and not reason:
        raise FormError(f"give a reason for {fields['alarm'][:100]}")
    return AlarmCommand(
        verb=verb,
        alarm=fields["alarm"],
        by=person.name,
        duration_s=float(hours) * 3600.0 if verb is Verb.SHELVE else None,
        occurrence=fields.get("occurrence") or None,
        reason=reason,
        machine=machine,
    )


def _shown(request: Request, machine: str, alarm: str, secret: str) -> Response:
    there = request.url_for("alarms", machine=machine).include_query_params(alarm=alarm, outcome=secret)
    return RedirectResponse(f"{there.path}?{there.query}", 303)
