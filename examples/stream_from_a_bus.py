"""Stream samples of all axes from a CAN bus. Nothing moves.

With a simulated cell, in two terminals:

    drivegain simulate clean
    python examples/stream_from_a_bus.py socketcand:can0@127.0.0.1:29536

With amplifiers on SocketCAN: `python examples/stream_from_a_bus.py socketcan:can0`.
"""

import sys
from itertools import islice

import drivers


def main(
    address: str, pacing: drivers.LockstepSync | drivers.TimedSync, samples: int = 100
) -> None:
    """Print the positions and currents of every CiA 402 drive on a bus."""
    # Who is on the bus? This changes nothing. A statusword shows a CiA 402 drive.
    found = [node for node in drivers.scan(address) if node.state is not None]

    # An axis is a name, a node id and a profile: which objects hold position and current. The
    # default, CIA402, follows the standard; other makes are a DriveProfile.
    axes = [
        drivers.Axis(f"J{node.node_id}", node.node_id, identity=node.identity) for node in found
    ]

    # Set the drives up: PDO mapping, heartbeats. Leaving the block restores all objects, also after
    # an error.
    with drivers.open_cell(address, axes) as cell:
        ampere_per_unit = cell.ampere_per_unit()
        stream = drivers.SyncStream(cell, pacing)
        for sample in islice(stream, samples):
            currents_a = [
                raw * scale for raw, scale in zip(sample.current_raw, ampere_per_unit, strict=True)
            ]
            print(
                sample.cycle, sample.position_counts, [f"{current:.3f} A" for current in currents_a]
            )
        print(f"{stream.statistics.frames} frames, {stream.statistics.missing} missing")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(
            "error: found no address of a bus, or several; expected one, as in: "
            "stream_from_a_bus.py socketcan:can0"
        )
    try:
        main(sys.argv[1], drivers.TimedSync(period_ns=10_000_000))
    except drivers.DriverError as error:  # every error of the bus and the drives has this root
        sys.exit(f"error: {error}")
