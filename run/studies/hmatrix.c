/* The inverse of a dense matrix whose entries depend on |differences| of grid points, by hmat-oss (1.8): LL' of an
   H-matrix. gcc -O3 -shared -fPIC hmatrix.c -lhmat; kernels.py calls it. */
#include <math.h>
#include <stdlib.h>
#include <hmat/hmat.h>

static struct {
    int dimension;
    const int *points;   /* (n, dimension) */
    const int *shape;    /* of the table */
    const double *table; /* entry for each |difference| */
} given;
static hmat_interface_t hmat;
static hmat_matrix_t *matrix;

static void entry(void *unused, int i, int j, void *result) {
    const int *x = given.points + (long)i * given.dimension, *y = given.points + (long)j * given.dimension;
    long place = 0;
    for (int a = 0; a < given.dimension; a++) place = place * given.shape[a] + abs(x[a] - y[a]);
    *(double *)result = given.table[place];
}

/* Assemble and factorise to eps; 0 if it worked. bytes: of the factor. */
int factorise(int n, int dimension, const int *points, const int *shape, const double *table, double eps, double *bytes) {
    given.dimension = dimension, given.points = points, given.shape = shape, given.table = table;
    hmat_init_default_interface(&hmat, HMAT_DOUBLE_PRECISION);
    if (hmat.init() != 0) return 1;
    double *coordinates = malloc(sizeof(double) * (size_t)n * dimension);
    for (long k = 0; k < (long)n * dimension; k++) coordinates[k] = points[k];
    hmat_clustering_algorithm_t *clustering = hmat_create_clustering_median();
    hmat_cluster_tree_t *tree = hmat_create_cluster_tree(coordinates, dimension, n, clustering);
    hmat_admissibility_t *admissible = hmat_create_admissibility_standard(2.0);
    matrix = hmat.create_empty_hmatrix_admissibility(tree, tree, 1, admissible);
    hmat.set_low_rank_epsilon(matrix, eps);
    hmat_assemble_context_t assembly;
    hmat_assemble_context_init(&assembly);
    assembly.simple_compute = entry;
    assembly.compression = hmat_create_compression_aca_plus(eps);
    assembly.lower_symmetric = 1;
    assembly.progress = NULL;
    if (hmat.assemble_generic(matrix, &assembly) != 0) return 2;
    hmat_factorization_context_t factorization;
    hmat_factorization_context_init(&factorization);
    factorization.factorization = hmat_factorization_llt;
    factorization.progress = NULL;
    if (hmat.factorize_generic(matrix, &factorization) != 0) return 3;
    hmat_info_t info;
    hmat.get_info(matrix, &info);
    *bytes = 8.0 * info.compressed_size;
    free(coordinates);
    return 0;
}

int solve(double *b) {
    return hmat.solve_systems(matrix, b, 1);
}
