# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Crashes of a recording node, for as long as wanted: nothing that it acknowledged may be lost.

A node in mapping gets images, is killed or stopped, and started again. In between, at random: its
map is saved, another map is copied over it, its folder is removed, its disk is full, or many
clients call its services. Each image that is answered as MAPPED, or as MATCH, is acknowledged; at
the end of a round its stamp must be in a map of the folder, or in one recovered from a journal
there.

``make crash-test HOURS=2``, or ``python3 test/crash_run.py HOURS [SEED]`` with test/shared on
PYTHONPATH.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
import random
import resource
import shutil
import signal
import sys
import tempfile
import time

from fixtures import route_images
from map_examples import example_files
from processes import node_process, Process
from rclpy.qos import QoSProfile
from robot import PARAMETERS, Robot
from stavpr_msgs.msg import PlaceMatch
from stavpr_msgs.srv import SaveMap
from stavpr_ros.mapping import load_map
from stavpr_ros.mapping.journal_map import journals, recover
from std_srvs.srv import Trigger

LIVES = 3  # of the node in a round
SETTLED = 3.0  # seconds after which a journal that was removed, or had no room, is written anew
CALLS = 200  # of all clients at once
UNLIMITED = resource.RLIM_INFINITY


class Round:
    """One folder, and the lives of the node that records into it."""

    def __init__(self, robot: Robot, rng: random.Random, counts: Counter, folder: Path) -> None:
        self.robot, self.rng, self.counts = robot, rng, counts
        self.maps, self.log = folder / 'maps', folder / 'log'
        self.target = self.maps / 'route.stavpr'
        self.maps.mkdir()
        self.images = route_images(60)
        self.other = example_files(folder)[0]  # content of another map
        # stamp of each acknowledged image: time from which on it must survive a kill
        self.due: dict[int, float] = {}
        self.in_files: set[int] = set()  # of them those in map files
        self.settled = 0.0  # time from which on the journal is complete
        self.node: Process

    def run(self) -> None:
        """Run the lives of a node, and look for every acknowledged image."""
        steps = (self.save, self.copy_over, self.remove_folder, self.fill_disk, self.call)
        for _ in range(LIVES):
            self.start()
            for step in self.rng.choices(steps, k=self.rng.randrange(4)):
                self.drive()
                step()
                self.counts[step.__name__] += 1
            self.drive()
            self.end()
        missing = self.due.keys() - self.found()
        self.counts['acknowledged'] += len(self.due)
        self.counts['lost'] += len(missing)
        if missing:
            shutil.copytree(self.maps.parent, f'lost-{time.time_ns()}')

    def start(self) -> None:
        """Start the node; it recovers what the last one has left."""
        self.robot.forget()
        values = PARAMETERS | {'maps_folder': self.maps, 'save_path': self.target}
        self.maps.mkdir(exist_ok=True)
        self.node = node_process(self.log, operation='mapping', **values)
        self.robot.until(lambda: 'backend' in self.node.output(), 'the node')
        self.robot.wait_for_node()
        self.in_files = set(self.due)

    def drive(self) -> None:
        """Show images; those that are mapped are acknowledged."""
        for _ in range(self.rng.randrange(1, 40)):
            match = self.robot.show(self.rng.choice(self.images))
            if match.status in (PlaceMatch.MAPPED, PlaceMatch.MATCH):
                self.due[self.robot.stamp] = self.settled

    def end(self) -> None:
        """Kill the node, or stop it; what is due later may be lost with it."""
        number = self.rng.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGTERM))
        code = self.node.stop(number)
        self.counts[signal.Signals(number).name] += 1
        if number == signal.SIGKILL:
            self.forgive(lambda stamp: self.due[stamp] > time.monotonic())
        elif code != 0:
            self.counts['exit codes'] += 1

    def save(self) -> None:
        """Save the map under a new name: it then contains all that this node has acknowledged."""
        before = set(self.due)
        name = f'saved-{time.time_ns()}.stavpr'
        if self.robot.call(SaveMap, 'save_map', path=name).success:
            self.in_files |= before

    def copy_over(self) -> None:
        """Copy another map over one of the folder: the places in it are gone by this."""
        files = sorted(self.maps.glob('*.stavpr')) or [self.target]
        self.rng.choice(files).write_bytes(self.other)
        self.forgive(lambda stamp: stamp in self.in_files)

    def remove_folder(self) -> None:
        """Remove the folder; the node has what is in no map, and writes it anew."""
        shutil.rmtree(self.maps)
        self.maps.mkdir()
        self.forgive(lambda stamp: stamp in self.in_files)
        self.postpone()

    def fill_disk(self) -> None:
        """Let no file grow for a time."""
        pid = self.node.popen.pid
        sizes = [path.stat().st_size for path in self.maps.iterdir()]
        limit = max(sizes, default=0) + self.rng.randrange(20_000)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, UNLIMITED))
        self.drive()
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (UNLIMITED, UNLIMITED))
        self.postpone()

    def call(self) -> None:
        """Call a service many times at once; each call must get a response."""
        node, qos = self.robot.node, QoSProfile(depth=CALLS)
        client = node.create_client(Trigger, '/stavpr/reset', qos_profile=qos)
        try:
            self.robot.call(Trigger, 'reset')  # the node has discovered the client
            self.robot.until(client.service_is_ready, 'the service')
            responses = [client.call_async(Trigger.Request()) for _ in range(CALLS)]
            end = time.monotonic() + 10
            while not all(response.done() for response in responses) and time.monotonic() < end:
                self.robot.executor.spin_once(timeout_sec=0.05)
        finally:
            node.destroy_client(client)
        self.counts['calls'] += CALLS
        self.counts['calls without response'] += sum(not response.done() for response in responses)

    def postpone(self) -> None:
        """Require what is in no file, now and for a while, only after this while."""
        self.settled = time.monotonic() + SETTLED
        for stamp in self.due.keys() - self.in_files:
            self.due[stamp] = self.settled

    def forgive(self, condition: Callable[[int], bool]) -> None:
        """Require stamps no longer."""
        self.due = {stamp: at for stamp, at in self.due.items() if not condition(stamp)}

    def found(self) -> set[int]:
        """Return the stamps in all maps, recovered ones too."""
        for journal in journals(self.target):
            recover(journal)
        maps = [load_map(path) for path in self.maps.glob('*.stavpr')]
        return {int(stamp) for place_map in maps for stamp in place_map.stamps}


def main(hours: float, seed: int) -> None:
    """Run rounds until the time is over; print the counts after each."""
    rng, counts, end = random.Random(seed), Counter(), time.monotonic() + 3600 * hours
    while time.monotonic() < end:
        robot = Robot()
        try:
            with tempfile.TemporaryDirectory() as folder:
                lives = Round(robot, rng, counts, Path(folder))
                try:
                    lives.run()
                finally:
                    lives.node.popen.kill()
        finally:
            robot.close()
        counts['rounds'] += 1
        print(dict(counts), flush=True)
    if counts['lost'] or counts['calls without response']:
        sys.exit(1)


if __name__ == '__main__':
    main(float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
