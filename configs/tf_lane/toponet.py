"""TopoNet's lane branch on the built-in world, at a size for two cores: the baseline without priors.

    tflane train --config tf_lane/toponet
    tflane train --config tf_lane/toponet:street

The second runs on simpler roads in a smaller box, where learned queries alone do better than lane proposals. What each
part of the recipe gives: docs/small_models.md.

`tflane tables tf_lane.2`, 2,500 updates of `:street`, eight seeds: DET_l 45.5 ± 0.8, recall of hidden lanes that
vehicles drove along 50.6 ± 1.3 percent.
"""

from dataclasses import replace

from tflane_jax.config import RunConfig, WorldData
from tflane_jax.config_io import with_setting
from tflane_jax.losses.toponet import TopoNetLossConfig
from tflane_jax.models.evidence_encoder import EvidenceEncoderConfig
from tflane_jax.models.lane_denoising import DenoisingConfig
from tflane_jax.models.lane_queries import LaneDecoderConfig, LaneProposalConfig
from tflane_jax.models.toponet import TopoNetConfig
from tflane_jax.tasks.lane_graph import LaneGraphTask
from tflane_jax.training.loop import TrainingConfig
from tflane_jax.training.schedule import OptimConfig

PROPOSALS = LaneProposalConfig(count=36)


def get_config() -> RunConfig:
    """Return the baseline on the preset `city`."""
    data = WorldData.city()
    return _small(_host(data, PROPOSALS), data, steps=9000)


def ablations() -> dict[str, RunConfig]:
    """Return the baseline on the preset `street`, the same with one part changed, and TopoNet's published forms.

    `street_plain` has the published forms but for the refinement, the class target and the weight of the topology.
    """
    data = WorldData.street()
    model = _host(data)
    street = _small(model, data, steps=7000)
    optim, decoder, encoder = street.optim, model.decoder, model.encoder

    def changed(**changes) -> RunConfig:
        return with_setting(street, "task.model", replace(model, **changes))

    without_context = replace(encoder, levels=(), dilations=(1, 2, 4, 1), coordinates=False)
    plain = replace(decoder, output="sigmoid", layers=3)
    adam = replace(optim, lr=1.5e-3, optimizer="adam")
    street_plain = replace(changed(decoder=plain, encoder=without_context, denoising=None), optim=adam)
    published = replace(model, encoder=without_context, decoder=replace(plain, refine="fixed"), denoising=None)
    return {
        "street": street,
        "street_sigmoid": changed(decoder=replace(decoder, output="sigmoid")),
        "street_proposals": changed(decoder=replace(decoder, proposals=PROPOSALS)),
        "street_without_context": changed(encoder=without_context),
        "street_without_denoising": changed(denoising=None),
        "street_class_one": with_setting(street, "task.losses.class_target", "one"),
        "street_muon_dense": replace(street, optim=replace(optim, muon_kernels="dense")),
        "street_adam": replace(street, optim=adam),
        "street_plain": street_plain,
        "street_published": replace(
            street, task=replace(street.task, model=published, losses=TopoNetLossConfig()), optim=adam
        ),
    }


def _host(data: WorldData, proposals: LaneProposalConfig | None = None) -> TopoNetConfig:
    """Return a host that learns within minutes; docs/small_models.md tells what is TopoNet's and what is not."""
    encoder = EvidenceEncoderConfig(dim=64, levels=(96, 128), dilations=(), coordinates=True, range=data.example.ground)
    decoder = LaneDecoderConfig(layers=2, queries=48, output="metric", proposals=proposals)
    return TopoNetConfig(
        encoder=encoder, range=data.example.range, decoder=decoder, denoising=DenoisingConfig(copies=1)
    )


def _small(host: TopoNetConfig, data: WorldData, steps: int) -> RunConfig:
    """Return the training of the host; clipping and b2 are those of the earlier small configurations."""
    return RunConfig(
        task=LaneGraphTask(
            host,
            # The topology loss is a mean over all pairs of queries, so that a small model needs a larger weight.
            TopoNetLossConfig(successor_weight=20.0, class_target="quality"),
        ),
        data=data,
        optim=OptimConfig(
            lr=4e-3,
            warmup_steps=100,
            b2=0.99,
            clip_norm=5.0,
            optimizer="muon",
            muon_kernels="dense_and_convolution",
        ),
        training=TrainingConfig(steps=steps, batch_size=4, eval_every=1000, checkpoint_every=1000),
    )
