"""What the option `squeeze` does for recorded picks, by `handmap simulate`.

    python benchmarks squeeze 5 hand.npz --robot leap_right --trials 24 --seed 5601

The first argument is the force [N], the others are those of `handmap simulate`. Tables have the
preset as it is and with the force: `teleoperation` and `squeezing`.
"""

import sys

from handmap_qp import Teleoperation
from handmap_qp.cli import main
from handmap_qp.mapping.methods import teleoperation

if __name__ == "__main__":
    force, *words = sys.argv[1:]
    # Presets are read from here at their first use.
    presets = teleoperation.PRESETS
    pressing = Teleoperation(squeeze=float(force))
    presets["squeezing"] = presets["teleoperation"]._replace(method=pressing)
    sys.exit(main(["simulate", *words, "--methods", "teleoperation", "squeezing"]))
