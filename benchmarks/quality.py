"""PSNR, SSIM and LPIPS against the full scene, of every preset.

``python -m benchmarks.quality`` scores generated scenes with cvtgs' own renderer and views.
Scenes of your own: name the files. LPIPS: ``--lpips WEIGHTS``. Another judge: ``--scorer "python
score.py --json {full} {small}"``; it gets the full scene and the small ones, and prints a JSON
list of objects with ``psnr``, ``ssim`` and perhaps ``lpips``, in that order.
"""

import cvtgs
from benchmarks.scoring import markdown, measure, scoring_parser, variants_of


def main() -> None:
    options = scoring_parser(__doc__).parse_args()
    variants = variants_of(options, {name: {"preset": name} for name in cvtgs.PRESETS})
    *_, table = measure(variants, options)
    print(markdown(table, options.rho, means_only=options.means))


if __name__ == "__main__":
    main()
