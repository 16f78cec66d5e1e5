"""Plan the most informative experiment: between the members of a tie, or of parameters that no run shows.

question    what a diagnosis leaves open, or what the user asks                    questions
members     what may be true, fitted to the runs there are                         members
search      inputs within limits, by their evidence whichever member is true       limits, paths, proposals
rehearse    with noise, fitted as the measured run will be                         rehearsal
report      `Experiment`: what to do, its expected evidence, what to see           experiment
obtain      the evidence of a flown experiment, beside the expected one             flown
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.design.designing import design
    from nsde_torch.design.experiment import Experiment
    from nsde_torch.design.flown import Obtained, obtained
    from nsde_torch.design.options import DesignOptions
    from nsde_torch.design.questions import Question, Standing, open_questions, question_of, standing_of

__all__ = names(__name__)
__getattr__ = resolver(__name__)
