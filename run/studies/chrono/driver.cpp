// One time step of Chrono from a state in a file, from zero impulses: driver SCENE SOLVER ITERATIONS REPEATS IMPULSES
//
// SOLVER is "multicore apgd", "multicore bb", "core psor" or "core bb" as one argument. It runs all of ITERATIONS: no
// tolerance ends it. The step is made REPEATS times, each in a system of its own. Standard output gets a JSON object
// with the seconds of each, IMPULSES the contacts of the last: for each 14 doubles, numbers of its two bodies (spheres
// first, then boxes), impulse on the second body [N s] (3), normal from first to second (3), the points on the two
// surfaces [m] (3 + 3).
//
// SCENE is text, numbers between white space: gravity (3), dt, greatest gap of a contact, friction coefficient, number
// of spheres and of boxes; for each sphere position (3), velocity (6), radius, mass, moment of inertia; for each box
// position (3), quaternion (4), velocity (6), half extents (3). Boxes keep their velocities. SI units, velocities
// linear and angular. compare_chrono.py writes it.

#include <algorithm>
#include <cmath>
#include <fstream>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "chrono/ChVersion.h"
#include "chrono/collision/ChCollisionShapeBox.h"
#include "chrono/collision/ChCollisionShapeSphere.h"
#include "chrono/collision/multicore/ChCollisionSystemMulticore.h"
#include "chrono/physics/ChBody.h"
#include "chrono/physics/ChContactContainer.h"
#include "chrono/physics/ChContactMaterialNSC.h"
#include "chrono/physics/ChSystemNSC.h"
#include "chrono/solver/ChIterativeSolverVI.h"
#include "chrono_multicore/constraints/ChConstraintUtils.h"
#include "chrono_multicore/physics/ChSystemMulticore.h"

using namespace chrono;

namespace {

struct Sphere {
    ChVector3d position, velocity, spin;
    double radius, mass, inertia;
};

struct Box {
    ChVector3d position;
    ChQuaterniond turn;
    ChVector3d velocity, spin, half;
};

struct Scene {
    ChVector3d gravity;
    double dt, gap, friction;
    std::vector<Sphere> spheres;
    std::vector<Box> boxes;
};

struct Contact {
    double first, second;
    double impulse[3], normal[3], on_first[3], on_second[3];
};

struct Seconds {
    double step, collision, setup, solve;
};

using Contacts = std::vector<Contact>;

ChVector3d read_vector(std::istream& file) {
    double x, y, z;
    file >> x >> y >> z;
    return {x, y, z};
}

Scene read_scene(const std::string& path) {
    std::ifstream file(path);
    Scene scene;
    size_t spheres = 0, boxes = 0;
    scene.gravity = read_vector(file);
    file >> scene.dt >> scene.gap >> scene.friction >> spheres >> boxes;
    scene.spheres.resize(file ? spheres : 0);
    for (auto& s : scene.spheres) {
        s.position = read_vector(file), s.velocity = read_vector(file), s.spin = read_vector(file);
        file >> s.radius >> s.mass >> s.inertia;
    }
    scene.boxes.resize(file ? boxes : 0);
    for (auto& b : scene.boxes) {
        b.position = read_vector(file);
        double turn[4];
        file >> turn[0] >> turn[1] >> turn[2] >> turn[3];
        b.turn.Set(turn[0], turn[1], turn[2], turn[3]);
        b.velocity = read_vector(file), b.spin = read_vector(file), b.half = read_vector(file);
    }
    if (!file)
        throw std::runtime_error("cannot read the scene " + path);
    return scene;
}

const double immovable = 1e12;  // kg and kg m^2: Chrono's core takes no velocities of fixed bodies

void add_bodies(ChSystem& system, const Scene& scene, bool fixed_bodies_move) {
    auto material = chrono_types::make_shared<ChContactMaterialNSC>();
    material->SetFriction(static_cast<float>(scene.friction));
    material->SetRestitution(0);
    auto add = [&](std::shared_ptr<ChBody> body, std::shared_ptr<ChCollisionShape> shape, ChVector3d velocity,
                   ChVector3d spin) {
        body->AddCollisionShape(shape);
        body->EnableCollision(true);
        body->SetPosDt(velocity);
        body->SetAngVelParent(spin);
        system.AddBody(body);
    };
    for (const auto& s : scene.spheres) {
        auto body = chrono_types::make_shared<ChBody>();
        body->SetMass(s.mass);
        body->SetInertiaXX(ChVector3d(s.inertia));
        body->SetPos(s.position);
        add(body, chrono_types::make_shared<ChCollisionShapeSphere>(material, s.radius), s.velocity, s.spin);
    }
    for (const auto& b : scene.boxes) {
        auto body = chrono_types::make_shared<ChBody>();
        bool fixed = fixed_bodies_move || (b.velocity.Length() == 0 && b.spin.Length() == 0);
        body->SetFixed(fixed);
        body->SetMass(immovable);
        body->SetInertiaXX(ChVector3d(immovable));
        body->SetPos(b.position);
        body->SetRot(b.turn);
        auto shape = chrono_types::make_shared<ChCollisionShapeBox>(material, b.half * 2);
        add(body, shape, fixed ? b.velocity : b.velocity - scene.gravity * scene.dt, b.spin);
    }
    system.SetGravitationalAcceleration(scene.gravity);
}

void set(double (&out)[3], const ChVector3d& v) {
    out[0] = v.x(), out[1] = v.y(), out[2] = v.z();
}

ChVector3d vector_of(const real3& v) {
    return {v.x, v.y, v.z};
}

// Bins of about five spheres, as Chrono's own default has them for a few thousand.
int bins_per_axis(const Scene& scene) {
    return std::max(10, static_cast<int>(std::cbrt(scene.spheres.size() / 5.0)));
}

// ChSystemMulticoreNSC: contacts push apart within the step without a limit of speed, no compliance (alpha 0).
Seconds multicore_step(const Scene& scene, SolverType solver, int iterations, Contacts& found) {
    ChSystemMulticoreNSC system;
    system.SetNumThreads(1);
    system.SetCollisionSystemType(ChCollisionSystem::Type::MULTICORE);
    auto& settings = *system.GetSettings();
    settings.solver.solver_mode = SolverMode::SLIDING;
    settings.solver.max_iteration_normal = 0;
    settings.solver.max_iteration_sliding = iterations;
    settings.solver.max_iteration_spinning = 0;
    settings.solver.max_iteration_bilateral = 0;
    settings.solver.tol_speed = 0;
    settings.solver.alpha = 0;
    settings.solver.contact_recovery_speed = -1;
    settings.collision.collision_envelope = scene.gap / 2;
    int bins = bins_per_axis(scene);
    settings.collision.bins_per_axis = vec3(bins, bins, bins);
    system.ChangeSolverType(solver);
    add_bodies(system, scene, true);

    system.DoStepDynamics(scene.dt);

    const auto& data = *system.data_manager->cd_data;
    const auto& gamma = system.data_manager->host_data.gamma;
    const size_t count = data.num_rigid_contacts;
    found.resize(count);
    for (size_t i = 0; i < count; i++) {
        real3 n = data.norm_rigid_rigid[i], u, w;
        Orthogonalize(n, u, w);
        real3 impulse = n * gamma[i] + u * gamma[count + 2 * i] + w * gamma[count + 2 * i + 1];
        auto bodies = data.bids_rigid_rigid[i];
        found[i].first = bodies.x, found[i].second = bodies.y;
        set(found[i].impulse, vector_of(impulse));
        set(found[i].normal, vector_of(n));
        set(found[i].on_first, vector_of(data.cpta_rigid_rigid[i]));
        set(found[i].on_second, vector_of(data.cptb_rigid_rigid[i]));
    }
    return {system.GetTimerStep(), system.GetTimerCollision(), system.GetTimerAdvance() - system.GetTimerLSsolve(),
            system.GetTimerLSsolve()};
}

class Report : public ChContactContainer::ReportContactCallback {
  public:
    Report(double dt, Contacts& found) : dt(dt), found(found) {}

    bool OnReportContact(const ChVector3d& on_first, const ChVector3d& on_second, const ChMatrix33<>& frame, double,
                         double, const ChVector3d& force, const ChVector3d&, ChContactable* first,
                         ChContactable* second, int) override {
        Contact contact;
        contact.first = dynamic_cast<ChBody*>(first)->GetIndex();
        contact.second = dynamic_cast<ChBody*>(second)->GetIndex();
        set(contact.impulse, frame * (force * dt));
        set(contact.normal, frame.GetAxisX());
        set(contact.on_first, on_first);
        set(contact.on_second, on_second);
        found.push_back(contact);
        return true;
    }

  private:
    double dt;
    Contacts& found;
};

// ChSystemNSC, the system without Multicore, with the same search for contacts.
Seconds core_step(const Scene& scene, ChSolver::Type solver, int iterations, Contacts& found) {
    ChSystemNSC system;
    system.SetNumThreads(1, 1, 1);
    system.SetCollisionSystemType(ChCollisionSystem::Type::MULTICORE);
    auto search = std::static_pointer_cast<ChCollisionSystemMulticore>(system.GetCollisionSystem());
    search->SetEnvelope(scene.gap / 2);
    int bins = bins_per_axis(scene);
    search->SetBroadphaseGridResolution(ChVector3i(bins, bins, bins));
    system.SetMaxPenetrationRecoverySpeed(1e30);
    system.SetSolverType(solver);
    auto iterative = std::dynamic_pointer_cast<ChIterativeSolverVI>(system.GetSolver());
    iterative->SetMaxIterations(iterations);
    iterative->SetTolerance(0);
    iterative->EnableWarmStart(false);
    add_bodies(system, scene, false);
    system.DoStepDynamics(scene.dt);
    found.clear();
    system.GetContactContainer()->ReportAllContacts(chrono_types::make_shared<Report>(scene.dt, found));
    return {system.GetTimerStep(), system.GetTimerCollision(), system.GetTimerAdvance() - system.GetTimerLSsolve(),
            system.GetTimerLSsolve()};
}

Seconds step(const Scene& scene, const std::string& solver, int iterations, Contacts& found) {
    if (solver == "multicore apgd")
        return multicore_step(scene, SolverType::APGD, iterations, found);
    if (solver == "multicore bb")
        return multicore_step(scene, SolverType::BB, iterations, found);
    if (solver == "core psor")
        return core_step(scene, ChSolver::Type::PSOR, iterations, found);
    if (solver == "core bb")
        return core_step(scene, ChSolver::Type::BARZILAIBORWEIN, iterations, found);
    throw std::runtime_error("there is no solver " + solver);
}

void print(const char* name, const std::vector<Seconds>& all, double Seconds::*which) {
    std::cout << ", \"" << name << "\": [";
    for (size_t i = 0; i < all.size(); i++)
        std::cout << (i ? ", " : "") << all[i].*which;
    std::cout << "]";
}

}  // namespace

int main(int count, char** words) {
    if (count != 6) {
        std::cerr << "driver SCENE SOLVER ITERATIONS REPEATS IMPULSES" << std::endl;
        return 2;
    }
    try {
        Scene scene = read_scene(words[1]);
        Contacts found;
        std::vector<Seconds> all;
        for (int i = 0; i < std::stoi(words[4]); i++)
            all.push_back(step(scene, words[2], std::stoi(words[3]), found));
        std::ofstream file(words[5], std::ios::binary);
        file.write(reinterpret_cast<const char*>(found.data()), found.size() * sizeof(Contact));
        // Chrono's solvers print too: the object is the last line
        std::cout << "\n{\"version\": \"" << CHRONO_VERSION << "\", \"contacts\": " << found.size();
        print("step", all, &Seconds::step);
        print("collision", all, &Seconds::collision);
        print("setup", all, &Seconds::setup);
        print("solve", all, &Seconds::solve);
        std::cout << "}" << std::endl;
    } catch (const std::exception& error) {
        std::cerr << error.what() << std::endl;
        return 1;
    }
}
