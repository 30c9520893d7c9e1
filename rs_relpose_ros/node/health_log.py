"""What the log says of the health: a line for what is off, and one when all is well again."""

from __future__ import annotations

from rs_relpose_ros.health.findings import Health, HealthState
from rs_relpose_ros.node.cause_log import CauseLog


class HealthLog:
    """Tells the health after each pair; of one figure at most a line per period of the logs."""

    def __init__(self, info: CauseLog, warn: CauseLog, error: CauseLog) -> None:
        self._info, self._warn, self._error = info, warn, error
        self._told_of_faults = False

    def __call__(self, health: Health, *, withhold: bool) -> None:
        """Tell of a pair; `withhold`: whether poses are withheld where the health is wrong."""
        faults = health.faults
        if faults:
            # The numbers and lesser faults change from pair to pair, the worst figure hardly.
            text, cause = '; '.join(fault.text for fault in faults), faults[0].figure
            if health.is_gross:
                # A gross error has a remedy of its own, which the first small steps do not know.
                cause += ', gross'
            if health.state is HealthState.WRONG:
                self._error(f'{text}; ' + (
                    'poses are withheld: withhold_when_wrong: false publishes them all the same'
                    if withhold else
                    'poses are published all the same, as withhold_when_wrong is false'), cause)
            else:
                self._warn(text, cause)
        elif self._told_of_faults:
            self._info(f'health is {health.state.value}: no figure that was told is suspect or '
                       'wrong any more')
        self._told_of_faults = bool(faults)
