{# Products with the Jacobians of a step: A, B, and Q = J^T J of the roots of the cost; and m - h^T h. #}
{% set square, to = "real (*restrict m)[LD], ", "real (*restrict out)[LD]" %}
{% call void("a_times(", "a", square ~ to) %}
{% for j in range(a.width) %}
    for (int c = 0; c < LD; c++) out[{{ j }}][c] = {{ a.column(j, "m[{}][c]") }};
{% endfor %}
{% endcall %}
{% call void("b_times(", "b", square ~ to) %}
{% for j in range(b.width) %}
    for (int c = 0; c < LD; c++) out[{{ j }}][c] = {{ b.column(j, "m[{}][c]") }};
{% endfor %}
{% endcall %}
{# of what is symmetric, one half #}
{% call void("times_a(" ~ square, "a", to) %}
{% for j in range(a.width) %}
    for (int c = {{ j }}; c < NR; c++) out[c][{{ j }}] = {{ a.column(j, "m[c][{}]") }};
{% endfor %}
{% endcall %}
{% call void("inputs_times_a(" ~ square, "a", to) %}
{% for j in range(a.width) %}
    for (int c = 0; c < NU; c++) out[c][{{ j }}] = {{ a.column(j, "m[c][{}]") }};
{% endfor %}
{% endcall %}
{% call void("times_b(" ~ square, "b", "real (*restrict out)[NU]") %}
{% for j in range(b.width) %}
    for (int c = 0; c < NU; c++) out[c][{{ j }}] = {{ b.column(j, "m[c][{}]") }};
{% endfor %}
{% endcall %}
{% call void("forward(", "a b dz du", "real *restrict out") %}
{% for i in range(nz) %}
    out[{{ i }}] = {{ a.row(i, "dz[{}]") }} + {{ b.row(i, "du[{}]") }};
{% endfor %}
{% endcall %}
{% call void("back_a(", "a l", "real *restrict out") %}
{% for j in range(nz) %}
    out[{{ j }}] = {{ a.column(j, "l[{}]") }};
{% endfor %}
{% endcall %}
{% call void("back_b(", "b l", "real *restrict out") %}
{% for j in range(b.width) %}
    out[{{ j }}] = {{ b.column(j, "l[{}]") }};
{% endfor %}
{% endcall %}
{# a sum in one go: a row that is stored and loaded again for each term takes twice as long #}
{% call void("less_square(real (*restrict h)[LD], ", "", to) %}
    for (int r = 0; r < NR; r++)
        for (int c = 0; c < LD; c++) out[r][c] -= {% for i in range(b.width) %}h[{{ i }}][r] * h[{{ i }}][c]{{ " + " if not loop.last }}{% endfor %};
{% endcall %}
{% call void("add_q(", "q", to) %}
{% for (i, j), entry in q.terms.items() %}
    out[{{ i }}][{{ j }}] += {{ entry }};
{% endfor %}
{% endcall %}
{% call void("times_q(", "q e", "real *restrict out") %}
{% for i in range(q.height) %}
    out[{{ i }}] = {{ q.row(i, "e[{}]") }};
{% endfor %}
{% endcall %}
