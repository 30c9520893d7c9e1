"""What the warm-up is for: afterwards no frame waits for a compiler."""

from __future__ import annotations

import json
import subprocess
import sys

from conftest import ROOT
import pytest

# In a process of its own: other tests compile kernels in this one.
PROGRAM = """
import gc
import json
import sys
from numba.core.dispatcher import Dispatcher
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.front_end.front_end import FrameProcessed, FrontEnd
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role
from rs_relpose_ros.front_end.warm_up import warm_up_pipeline
from rs_relpose_ros.config.parameter_file import read_parameters

def kernels():
    return {f'{k.py_func.__module__}.{k.py_func.__name__}': len(k.overloads)
            for k in gc.get_objects() if isinstance(k, Dispatcher)
            and k.py_func.__module__.startswith('rs_relpose_ros')}

parameters = read_parameters(sys.argv[2], sys.argv[3:])
warm_up_pipeline(parameters)
before = kernels()
front_end = FrontEnd(parameters, offline=True)
intake = Intake(front_end.sequencer)
statuses = set()
with open_bag(sys.argv[1]) as bag:
    topics = bag.find_topics()
    for role, item in intake.feed.messages(bag, topics):
        intake.receive(role, item.message)
        while isinstance(outcome := front_end.step(), FrameProcessed):
            if outcome.result is not None:
                statuses.add(outcome.result.pose.status.value)
after = kernels()
print(json.dumps([sorted(statuses), [k for k in after if after[k] != before[k]],
                  sum(before.values())]))
"""


@pytest.mark.timeout(600)
def test_nothing_is_compiled_after_the_warm_up(bundled_bag):
    out = subprocess.run(
        [sys.executable, '-c', PROGRAM, str(bundled_bag),
         str(ROOT / 'bags' / 'hand_held.yaml')],
        check=True, capture_output=True, text=True, timeout=590, cwd=ROOT)
    statuses, compiled_late, kernels = json.loads(out.stdout)
    # The bag holds motion, standstill and pure rotation: every path of the estimator.
    assert {'OK', 'PURE_ROTATION'} <= set(statuses)
    assert kernels > 5
    assert compiled_late == []
