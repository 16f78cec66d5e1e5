"""Every kind of model of the package holds the contract of kinds of models."""

import pickle

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.cli.schemas import CHOICES
from nsde_torch.data import Run
from nsde_torch.data.windows import Windows
from nsde_torch.errors import ConfigError
from nsde_torch.models import MODELS, Capabilities, Model, make_model, save
from nsde_torch.models.kind import Choice, model_kind, model_options, whole_steps
from nsde_torch.systems import SystemOptions
from tests.helpers.model_contract import ModelContract

CAN = {
    "nsde": Capabilities(
        has_physics=True, is_equation=True, is_stochastic=True, learns_sensors=True, knows_feedback=True
    ),
    "node": Capabilities(has_physics=True, is_equation=True),
    "blackbox_nsde": Capabilities(is_equation=True, is_stochastic=True, learns_sensors=True),
    "ensemble": Capabilities(propagation="fixed"),
    "sysid": Capabilities(has_physics=True),
}


@pytest.fixture(scope="module", params=MODELS)
def every(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Model:
    """A model of each kind as the data ask for it, saved before it is trained."""
    made = nsde_torch.simulate("mass_spring_damper", durations=[4.0] * 3, seed=1)
    data = nsde_torch.read(made, system="mass_spring_damper")
    machine = SystemOptions("mass_spring_damper")
    choice = Choice(
        options=model_options(request.param), system=machine, machine=machine.make(), runs=data.runs
    )
    spec = model_kind(request.param).make_spec(choice)
    model = make_model(spec, generator=torch.Generator().manual_seed(0))
    model.folder = tmp_path_factory.mktemp(request.param)
    save(model, model.folder)
    return model.eval().requires_grad_(False)


class TestEveryKind(ModelContract):
    @pytest.fixture
    def trained(self, every: Model) -> Model:
        return every

    def test_it_can_do_what_its_kind_can(self, trained: Model) -> None:
        assert trained.capabilities == CAN[trained.spec.kind]


@pytest.mark.parametrize(
    ("step", "dt"), [(0.01, 0.05), (0.0101, 0.0505), (0.008, 0.048), (0.004, 0.048), (0.08, 0.08)]
)
def test_a_machines_own_step_becomes_a_whole_multiple_of_the_datas(step: float, dt: float) -> None:
    # PX4 in simulation logs its states every 8 ms, and a quadrotor's own step is 50 ms
    run = Run("a", step * np.arange(20), np.zeros((20, 13)), np.zeros((20, 4)))
    assert whole_steps(0.05, [run]) == pytest.approx(dt, rel=0.011)
    Windows([run], whole_steps(0.05, [run]), 1)


def test_an_unknown_kind_lists_the_choices() -> None:
    with pytest.raises(
        ConfigError, match="must be one of nsde, node, blackbox_nsde, ensemble, sysid; got 'nsd'"
    ):
        model_kind("nsd")


@pytest.mark.parametrize("group", ["model", "data"])
def test_keys_of_a_choice_can_be_sent_to_another_process(group: str) -> None:
    for schema in CHOICES[group].values():
        assert pickle.loads(pickle.dumps(schema)) is schema
