# SPDX-License-Identifier: Apache-2.0
"""Send measurements to `graphloc stream` and print poses: python stream_client.py vessel.yaml measurements.jsonl.

What the lines say: docs/online-stream.md. A vessel would send each as its sensor gives it, not from a file.
"""

import json
import subprocess
import sys
import threading


def send(child, path):
    """Write all lines of a file; the end of the input ends the stream."""
    with child.stdin as pipe, open(path, "rb") as lines:
        for line in lines:
            pipe.write(line)
            pipe.flush()


def main():
    """Read answers while another thread sends: one that only writes would fill both pipes and wait for ever."""
    config, measurements = sys.argv[1:3]
    pipe = subprocess.PIPE
    child = subprocess.Popen(["graphloc", "stream", "-c", config], stdin=pipe, stdout=pipe)
    threading.Thread(target=send, args=(child, measurements), daemon=True).start()
    for line in child.stdout:
        said = json.loads(line)
        if said["type"] == "estimate":
            place = f"{said['lat_deg']:.7f}  {said['lon_deg']:.7f}  {said['heading_deg']:.1f} deg"
            print(f"{said['stamp']}  {place}  +- {said['bound_95_m']:.2f} m  {said['health']}")
        else:
            print(line.decode().rstrip(), file=sys.stderr)
    sys.exit(child.wait())


if __name__ == "__main__":
    main()
