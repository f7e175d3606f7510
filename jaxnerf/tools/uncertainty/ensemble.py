"""The estimator "ensemble": how much runs that differ in seed disagree (after arXiv:2209.08718)."""

import json

import jax.numpy as jnp
import numpy as np

from jaxnerf.core.types import Rays
from jaxnerf.evaluation.restore import newest_step, restore_run
from jaxnerf.runtime.fingerprint import fingerprint
from jaxnerf.tools.uncertainty.base import Estimate, UncertaintySource
from jaxnerf.tools.uncertainty.cleaning import MAX_UNCERTAINTY, cleaned


def estimate_ensemble(source: UncertaintySource) -> Estimate:
    """Makes the estimate of a run and the other members of its ensemble.

    The score is sqrt(v + (1 - a)^2): v is the variance over the members of the colour, mean over the channels, and
    a their mean opacity (Eq. 3 and 4 of arXiv:2209.08718). What a ray meets that no member has matter for is
    unknown. Where images have alpha, light that passes is known to come from the background, and the second term is
    absent. With few members v is small by chance in some pixels.

    Raises:
        ValueError: if there is no other member, one has another config, or two have the same parameters.
    """
    if not source.members:
        raise ValueError("the estimator 'ensemble' needs other runs of the same config; give --members=DIR,...")
    run, members = source.run, [(source.run.render_image, source.variables)]
    seen = {fingerprint(source.variables[0]): "the run itself"}
    settings = dict(run.settings)
    limit = settings.pop(MAX_UNCERTAINTY, None)
    for workdir in source.members:
        other = cleaned(restore_run(workdir, settings=settings), workdir, limit)
        if differing := _difference(other.identity, run.identity):
            raise ValueError(
                f"{workdir}: its field or sampler has other options than the run's, expected a run of the same config "
                f"with another seed; they differ in {differing}"
            )
        variables = other.variables(newest_step(other, workdir))
        found = fingerprint(variables[0])
        if found in seen:
            raise ValueError(f"{workdir}: has the parameters of {seen[found]}, expected a run with another seed")
        seen[found] = workdir
        members.append((other.render_image, variables))
    has_background = np.shape(source.views.pixels)[-1] == 4

    def score(rays: Rays):
        images = [render(variables, rays) for render, variables in members]
        variance = jnp.var(jnp.stack([image.rgb for image in images]), axis=0, ddof=1).mean(axis=-1)
        if has_background:
            return jnp.sqrt(variance)
        opacity = jnp.stack([image.opacity for image in images]).mean(axis=0)
        return jnp.sqrt(variance + (1 - opacity) ** 2)

    return Estimate(score, f"ensemble of {', '.join(sorted(seen))[:400]}")


def _difference(first, second):
    """Returns the names of options that differ between two identities of runs, the seed excepted; "" if none do."""
    first, second = json.loads(first), json.loads(second)
    names = sorted(name for name in {*first, *second} - {"seed"} if first.get(name) != second.get(name))
    return ", ".join(names[:5])
