"""A process that ends because of another one says so in one line. tests/slow/faults/each.py stops real processes."""

import re
import subprocess
import sys

import pytest

from jaxnerf.runtime import processes
from runs import ROOT, SMOKE_FLAGS, start_together

TWICE = (
    "E1123 12:03:45.78 9562 coordination_service.cc:518] 1 unexpectedly tried to connect with a different incarnation."
)
EARLY = (
    "W1124 23:29:39.22 20580 coordination_service.cc:388] [11] ConnectAfterBarrierPasses: CANCELLED: Cancelled because "
    "there's a more recent barrier call for [Init]Wait_for_all_tasks_to_register::0 from the same task."
)
SILENT = (
    "coordination_service.cc:1549] tasks are unhealthy (stopped sending heartbeats):\n1\n3\nThe tasks have crashed."
)


@pytest.mark.parametrize(
    "messages, line",
    [
        (TWICE, "process 1 has connected twice: --process_id=1 was given to two processes"),
        (f"{SILENT}\n{TWICE}", "process 1 has connected twice"),
        (SILENT, "process 1, 3 does not answer any more: it hangs"),
        ("client.h:80] absl::Status: UNAVAILABLE: Failed to send RPC to coordination service.", "process 0 does not"),
        (
            "client.h:80] absl::Status: DEADLINE_EXCEEDED: Deadline Exceeded\nRPC: Heartbeat",
            "process 0 does not answer",
        ),
        (EARLY, "a process has connected twice: one --process_id was given to two processes"),
        (
            "client.h:80] something\n    @     0x7f5b4a103b62  xla::CoordinationServiceAgent::Connect()\n",
            r"another process may have ended; start all .*checkpoint \(client.h:80\] something\)$",
        ),
        ("client.h:80] something\n new", r"another process may have ended; start all .*client.h:80\] something new"),
    ],
)
def test_describe(messages, line):
    assert re.match(line, processes.describe_loss(messages))


@pytest.mark.parametrize(
    "message, line", [(TWICE, "error: process 1 has connected"), (EARLY, "error: a process has connected")]
)
def test_an_abort_prints_one_line_and_other_messages_stay(message, line):
    program = f"""if True:
        import os, sys, time
        from jaxnerf.runtime import processes
        processes._LAST_WORDS = 0
        watch = processes.LostProcesses()
        os.write(2, b"a library's message\\n")
        watch.flush()
        print("the program's", file=sys.stderr)
        os.write(2, b"another\\n" + {message.encode()!r} + b"\\nmore of it\\n")
        os.abort()
    """
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    *others, last = done.stderr.splitlines()
    assert done.returncode == 1
    assert others == ["a library's message", "the program's", "another"]
    assert last.startswith(f"{line} twice: ")


@pytest.mark.slow
def test_one_process_id_given_twice_is_named(tmp_path):
    first, second = start_together(
        2, "train", *SMOKE_FLAGS, f"--workdir={tmp_path}/run", "--config.train.max_steps=999999"
    )
    third = subprocess.Popen(second.args, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    processes = (first, second, third)
    said = [process.communicate(timeout=100)[1] for process in processes]
    assert [process.returncode for process in processes] == [1, 1, 1], "\n".join(said)
    assert all(err.splitlines()[-1].startswith("error: ") and "stack" not in err for err in said), "\n".join(said)
    assert "error: process 1 has connected twice: --process_id=1 was given to two processes" in said[0]
