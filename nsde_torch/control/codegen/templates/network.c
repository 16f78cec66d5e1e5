{# A network as a function: outputs y and, if asked for, their slopes, backwards from each output. #}
{% for l in layers %}
static const real network_#_w{{ l.k }}[{{ l.n_in }}][{{ l.n_out }}] = {
    {{ l.weight }}};
static const real network_#_b{{ l.k }}[{{ l.n_out }}] = { {{- l.bias -}} };
{% endfor %}
static void network_#(const real *x, real *y, real (*slope)[{{ layers[0].n_in }}])
{
{% for l in layers %}
{% if not loop.last %}
    real {{ l.target }}[{{ l.n_out }}], s{{ l.k + 1 }}[{{ l.n_out }}];
{% endif %}
    copy(network_#_b{{ l.k }}, {{ l.target }}, {{ l.n_out }});
    for (int j = 0; j < {{ l.n_in }}; j++)
        for (int i = 0; i < {{ l.n_out }}; i++) {{ l.target }}[i] += network_#_w{{ l.k }}[j][i] * {{ l.source }}[j];
{% if not loop.last %}
    for (int i = 0; i < {{ l.n_out }}; i++) {
        const real a = {{ l.target }}[i];
{{ l.lines }}        {{ l.target }}[i] = {{ l.value }};
        s{{ l.k + 1 }}[i] = {{ l.slope }};
    }
{% endif %}
{% endfor %}
    for (int o = 0; slope && o < {{ layers[-1].n_out }}; o++) {
{% for l in layers|reverse %}
{% set g = "g%d"|format(l.k) if l.k else "slope[o]" %}
{% if l.k %}
        real {{ g }}[{{ l.n_in }}];
{% endif %}
        for (int j = 0; j < {{ l.n_in }}; j++) {
{% if loop.first %}
            {{ g }}[j] = network_#_w{{ l.k }}[j][o];
{% else %}
            {{ g }}[j] = 0;
            for (int i = 0; i < {{ l.n_out }}; i++)
                {{ g }}[j] += network_#_w{{ l.k }}[j][i] * g{{ l.k + 1 }}[i];
{% endif %}
{% if l.k %}
            {{ g }}[j] *= s{{ l.k }}[j];
{% endif %}
        }
{% endfor %}
    }
}
