"""What each choice of ``standard`` is worth: one is changed at a time.

``python -m benchmarks.choices --means`` takes the same scenes and judges as
``benchmarks.quality``. ``--set merge.network=false`` measures the choices without a network, which
was trained for all of them as they are.
"""

from collections.abc import Mapping

from benchmarks.scoring import markdown, measure, scoring_parser, variants_of


def powers(power: str) -> dict[str, str]:
    return {"cvt.area_power": power, "cvt.unbounded_area_power": power}


CHOICES: Mapping[str, Mapping[str, str]] = {
    "standard": {},
    "by position only": {"cvt.color": "0"},
    "colour as for 10,000 cells": {"cvt.color_power": "0"},
    "no perspective": {"cvt.perspective": "false"},
    "no ambient visibility": {"cvt.hidden_share": "1"},
    "weight by opacity (power 0)": powers("0"),
    "weight power 0.5": powers("0.5"),
    "weight power 0.8": powers("0.8"),
    "weight power 1 everywhere": powers("1"),
    "unbounded off": {"effects.unbounded": "off"},
    "seeds only, no Lloyd": {"cvt.iterations": "0"},
    "20 Lloyd iterations over all": {"cvt.iterations": "20", "cvt.samples_per_site": "0"},
    "paper's filter": {"filter.max_mass_share": "1"},
    "no filter": {"filter.max_mass_share": "0"},
    "members weigh by opacity": {"merge.area_power": "0"},
    "paper's opacity": {"merge.opacity": "union"},
    "moments of all members": {"merge.representatives": "false"},
    "no inflation": {"merge.inflation": "0", "merge.covered_inflation": "0"},
    "inflation without neighbours": {"merge.inflation": "0.3", "merge.covered_inflation": "0"},
    "paper": {"preset": "paper"},
}


def main() -> None:
    options = scoring_parser(__doc__).parse_args()
    *_, table = measure(variants_of(options, CHOICES), options)
    print(markdown(table, options.rho, means_only=options.means))


if __name__ == "__main__":
    main()
